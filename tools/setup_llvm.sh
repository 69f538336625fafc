#!/usr/bin/env bash
# setup_llvm.sh PYTHON: make sure that Dr.Jit finds a usable libLLVM; install one by apt if there is none.
set -euo pipefail
cd "$(dirname "$0")/.."

[ "$(uname -s)" = Linux ] || exit 0 # on other systems Dr.Jit finds it by itself
find_llvm() { "$1" -P morgs_mi/platform/llvm.py >/dev/null; } # run as a file, because importing the package needs LLVM

if problem=$(find_llvm "$1" 2>&1); then
    [ -z "$problem" ] || echo "setup: $problem" >&2
    exit 0
fi
# 19 is in Debian 12 and 13, in Ubuntu 24.04's updates and later; the others are in older or newer releases.
tools/apt_install.sh libllvm19 libllvm20 libllvm22 libllvm18 libllvm17 || {
    echo "setup: $problem" >&2
    exit 1
}
find_llvm "$1"
