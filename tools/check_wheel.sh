#!/usr/bin/env bash
# check_wheel.sh PYTHON: build sdist and wheel into dist/, and check the wheel in a new environment outside of the checkout.
set -euo pipefail
cd "$(dirname "$0")/.."

unset PYTHONPATH # pip would take a checkout there for the installed package
rm -rf dist build/lib
work=$(mktemp -d)
trap 'rm -rf "$work" morgs_mi.egg-info' EXIT
"$1" -m venv "$work/venv"
python=$work/venv/bin/python
"$python" -m pip install -q --disable-pip-version-check -c constraints.txt build
"$python" -m build --outdir dist . >"$work/log" 2>&1 || { cat "$work/log" >&2; exit 1; }
"$python" -m pip install -q --disable-pip-version-check -c constraints.txt dist/*.whl
cp tools/check_installed.py "$work"
cd "$work"
"$python" -I check_installed.py
