#!/usr/bin/env bash
# bundle.sh DEST: packages for a machine with a GPU that has Python 3.12, NumPy, SciPy, OpenCV, rich
# and pytest, but no network, as DEST/site.tar.xz (34 MB); and images and gradients of llvm_ad_rgb
# on this machine, for comparison, as DEST/reference.npz.
#
# LLVM (120 MB), PyAV and pycolmap are left out: llvm_ad_rgb, videos and calibration do not work
# there.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
dest=$(cd "$1" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

python3 -m pip download -q --no-deps --only-binary=:all: --python-version 3.12 \
  --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 \
  --platform manylinux2014_x86_64 --platform any -d "$work/wheels" \
  mitsuba==3.9.1 drjit==1.5.0 "constriction>=0.5,<0.6" "OpenEXR>=3.3,<4" "plyfile>=1.1,<2" \
  "tyro>=1.0,<2" docstring-parser typeguard shtab typing-extensions \
  "annotated-types>=0.7,<0.9" "lazy_loader>=0.5,<1" "imagesize>=2.0,<3" "filelock>=4.3,<5"
mkdir "$work/site"
for wheel in "$work"/wheels/*.whl; do python3 -m zipfile -e "$wheel" "$work/site"; done
cd "$work/site"
rm -rf mitsuba/*spectral* mitsuba/*mono* mitsuba/include mitsuba/cmake drjit/include drjit/cmake
tar -c . | xz -6 -T2 >"$dest/site.tar.xz"

cd "$here/../.."
python3 tools/gpu/check.py llvm_ad_rgb "$dest/reference.npz"
ls -l "$dest"
