#!/usr/bin/env bash
# setup_llvm.sh PYTHON: make sure that Dr.Jit finds a libLLVM it can use, installing one by apt if need be.
set -euo pipefail
cd "$(dirname "$0")/.."

[ "$(uname -s)" = Linux ] || exit 0 # elsewhere Dr.Jit's own search serves
find_llvm() { "$1" -P morgs_mi/core/llvm.py >/dev/null; } # as a file: importing the package needs LLVM already

if problem=$(find_llvm "$1" 2>&1); then
    [ -z "$problem" ] || echo "setup: $problem" >&2
    exit 0
fi
# 19 is in Debian 12 and 13, in Ubuntu 24.04's updates and later; the others are what older or newer releases have.
tools/apt_install.sh libllvm19 libllvm20 libllvm22 libllvm18 libllvm17 || {
    echo "setup: $problem" >&2
    exit 1
}
find_llvm "$1"
