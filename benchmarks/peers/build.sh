#!/usr/bin/env bash
# Builds the peers in a folder: sources are clones of WebODM/OpenSplat and ydah/gsplat in FOLDER/OpenSplat and
# FOLDER/ydah. Needs a C++ compiler, CMake and, from Debian, libtorch-dev and libopencv-dev.
set -euo pipefail
cd "${1:?usage: build.sh FOLDER}"

# OpenSplat 1.2.0 on Debian's torch 1.13, in which zero_grad() has no argument.
sed -i 's/zero_grad(true)/zero_grad()/' OpenSplat/model.cpp
cmake -S OpenSplat -B OpenSplat/build -DCMAKE_BUILD_TYPE=Release -DCMAKE_PREFIX_PATH=/usr
cmake --build OpenSplat/build -j"$(nproc)" --target opensplat

# The C kernels of ydah/gsplat without their Ruby bindings.
mkdir -p kernels
sed '/^static VALUE/,$d; /common.h/d; /VALUE native/d' ydah/ext/gsplat_native/raster_forward.c > kernels/forward.c
cp ydah/ext/gsplat_native/raster_backward.c ydah/ext/gsplat_native/rasterization.h kernels
cc -shared -fPIC -O3 -march=native -fopenmp -DGSPLAT_OPENMP=1 -o kernels/ydah.so kernels/*.c -lm

# gsplat 1.5.3 with PyTorch, in an environment of its own.
python3 -m venv torch
torch/bin/pip install -q torch jaxtyping rich ninja numpy
torch/bin/pip install -q --no-deps gsplat==1.5.3
