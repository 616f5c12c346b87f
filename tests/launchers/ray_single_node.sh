#!/usr/bin/env bash
# A Ray cluster with one node on this machine, a sweep through it, and what became of every job:
#     pip install -e '.[ray]'
#     tests/launchers/ray_single_node.sh [python]
# Its state lies in a temporary folder, and the cluster ends with the script. Results of one run: docs/scaling.md.
set -euo pipefail

PYTHON=$(realpath -s "${1:-python}")
ROOT=$(cd "$(dirname "$0")/../.." && pwd)
STATE=$(mktemp -d /tmp/ray.XXXX) # short: sockets lie in it
export RAY_USAGE_STATS_ENABLED=0 RAY_ADDRESS=127.0.0.1:6390
RAY=("$PYTHON" -c 'import sys; from ray.scripts.scripts import main; sys.exit(main())')

"${RAY[@]}" start --head --port=6390 --num-cpus=2 --temp-dir="$STATE/ray" --include-dashboard=false --block > "$STATE/log" 2>&1 &
CLUSTER=$!
finish() {
    kill "$CLUSTER" 2>/dev/null && wait "$CLUSTER" 2>/dev/null || true
    rm -rf "$STATE"
}
trap finish EXIT
until "${RAY[@]}" status > "$STATE/status" 2>/dev/null; do sleep 1; done
"$PYTHON" -c 'import ray; print("Ray", ray.__version__)'
grep -A 3 Resources "$STATE/status" || true

. "$ROOT/tests/launchers/single_node.sh"
LAUNCHER=(launcher=ray)
sweep_through "the sweep"
report
sweep_through "the same command once more"
report
