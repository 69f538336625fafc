#!/usr/bin/env bash
# run.sh BUNDLE OUT [VARIANT]: check and time the package, in the checkout's root on a machine with
# a GPU; five minutes. Results and logs are written to OUT, also when a step fails. The exit status
# is the number of steps that failed.
set -u
bundle=$1
out=$2
variant=${3:-cuda_ad_rgb}
mkdir -p "$out"
site=$(mktemp -d)
tar -xJf "$bundle/site.tar.xz" -C "$site"
export PYTHONPATH="$site:$PWD:${PYTHONPATH:-}" PYTHONUNBUFFERED=1 MORGS_MI_TEST_VARIANT=$variant
(nvidia-smi; python3 --version; nproc) >"$out/machine.txt" 2>&1

failed=0
step() { # NAME SECONDS COMMAND...
  local name=$1 limit=$2 start=$SECONDS status
  shift 2
  timeout "$limit" "$@" >"$out/$name.log" 2>&1
  status=$?
  [ "$status" = 0 ] || failed=$((failed + 1))
  echo "== $name: status $status, $((SECONDS - start)) s" | tee -a "$out/steps.txt"
  tail -n 30 "$out/$name.log"
}
step check 100 python3 tools/gpu/check.py "$variant" "$out/check.npz" "$bundle/reference.npz"
step speed 120 python3 tools/gpu/speed.py "$variant" "$out/speed.json"
step frames 260 python3 -m benchmarks.speed.frame_speed --variant "$variant" --epochs 2 --full \
  --json "$out/frames.json"
step host 100 python3 -m benchmarks.speed.host --variant "$variant" --sizes floor small \
  --json "$out/host.json"
step tests 200 python3 -m pytest -q -n 4 -p no:cacheprovider tests/render
exit "$failed"
