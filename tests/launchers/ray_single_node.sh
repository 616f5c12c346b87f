#!/usr/bin/env bash
# A Ray cluster with one node on this machine, a sweep through it, and what became of every job:
#     pip install -e '.[ray]'
#     tests/launchers/ray_single_node.sh [python]
# Its state lies in a temporary folder, and the cluster ends with the script. Kept output: docs/scaling.md.
set -euo pipefail

PYTHON=$(realpath -s "${1:-python}")
ROOT=$(cd "$(dirname "$0")/../.." && pwd)
STATE=$(mktemp -d /tmp/ray.XXXX) # short: sockets lie in it
export RAY_USAGE_STATS_ENABLED=0 PYTHONPATH="$ROOT/tests/launchers" RAY_ADDRESS=127.0.0.1:6390
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

# Rows: a job left alone, one that is killed after step 4, one that cannot be built. Two jobs at a time.
SPY=+callbacks.spy._target_=interrupting.Interrupt
ROWS="{whole:{set:['$SPY']},\
killed:{set:['$SPY','+callbacks.spy.step=4','+callbacks.spy.name=SIGKILL']},\
broken:{set:['init.opacity=2.0']}}"
sweep() {
    "$PYTHON" "$ROOT/src/train.py" -m method=3dgs data.size=tiny data.downscale=4 max_steps=8 callbacks.images=null \
        callbacks.probes=null callbacks.costs.fps_repeats=1 trainer.limit_val_batches=1 trainer.limit_test_batches=1 \
        seed=0 launcher=ray "hydra.sweeper.rows=$ROWS" "hydra.sweep.dir=$STATE/sweep" 2>&1
}
report() {
    for job in "$STATE"/sweep/3dgs_*; do
        printf '%s  metrics.json: %s  FAILED: %s\n' "$(sed -n 's/.*row=//p' "$job/.hydra/overrides.yaml" | tr -d "'\"")" \
            "$([ -f "$job/metrics.json" ] && echo yes || echo no)" "$(grep -E '^[A-Za-z_.]*(Error|Exception)' "$job/FAILED" 2>/dev/null | tail -n 1 | grep . || echo no)"
        grep -h 'going on from step' "$job/run.log" | sed 's/.*\(going on from step [0-9]*\).*/    \1/' || true
    done
    cat "$STATE/sweep/table.md"
}
echo "== the sweep" && sweep | grep -E '#[0-9]+ (done|died|FAILED|has)' | cut -c 1-100 || true
report
echo "== the same command once more" && sweep | grep -E '#[0-9]+ (done|died|FAILED|has)' | cut -c 1-100 || true
report
