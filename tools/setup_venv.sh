#!/usr/bin/env bash
# setup_venv.sh PYTHON FOLDER: create the environment and install the package with pinned versions.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1 venv=$2

log() { echo "setup: $*" >&2; }

if ! command -v "$python" >/dev/null; then
    tools/apt_install.sh python3 || { log "no $python found: install Python 3.11 or newer."; exit 1; }
fi
recent() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }
if ! recent "$python"; then
    # Ubuntu 22.04 has 3.10 as python3 and 3.11 beside it.
    for candidate in python3.14 python3.13 python3.12 python3.11; do
        recent "$candidate" && break
    done
    if ! recent "$candidate"; then
        candidate=python3.11
        tools/apt_install.sh python3.11 && recent $candidate || {
            log "$("$python" --version) is too old: install Python 3.11 or newer and run make PYTHON=/path/to/it."
            exit 1
        }
    fi
    python=$candidate
fi

if [ ! -x "$venv/bin/python" ] || ! "$venv/bin/python" -c 'import pip' 2>/dev/null; then
    if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        tools/apt_install.sh "python$version-venv" python3-venv || {
            log "$python cannot create environments: install the package python$version-venv (apt-get install python$version-venv)."
            exit 1
        }
    fi
    "$python" -m venv --clear "$venv"
fi
log "Installing packages (1 to 3 min)"
# Older ones, such as Debian 12's, do not show which package they install.
"$venv/bin/python" -m pip install -q --disable-pip-version-check 'pip>=25.1'
"$venv/bin/python" -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev,docs,notebooks,browser,usd,cluster]'
