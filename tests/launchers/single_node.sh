# What the scripts with one node share: a sweep and what became of its jobs. Sourced, with PYTHON, ROOT and STATE set, and with
# LAUNCHER (overrides) and ROWS (further jobs).
export PYTHONPATH="$ROOT/tests/launchers"
SPY=+callbacks.spy._target_=interrupting.Interrupt

# Rows: a job left alone, one that is killed after step 4, one that cannot be built, and those of ROWS. Two jobs at a time.
sweep() {
    "$PYTHON" "$ROOT/src/train.py" -m method=3dgs data.size=tiny data.downscale=4 max_steps=8 callbacks.images=null \
        callbacks.probes=null callbacks.costs.fps_repeats=1 trainer.limit_val_batches=1 trainer.limit_test_batches=1 \
        seed=0 "${LAUNCHER[@]}" "hydra.sweeper.rows={whole:{set:['$SPY']},\
killed:{set:['$SPY','+callbacks.spy.step=4','+callbacks.spy.name=SIGKILL']},${ROWS:-}\
broken:{set:['init.opacity=2.0']}}" "hydra.sweep.dir=$STATE/sweep" 2>&1
}

# Every job with its results, the reason of its failure and the steps from which it went on; then the table.
report() {
    local job row done failed
    for job in "$STATE"/sweep/3dgs_*; do
        row=$(sed -n 's/.*row=//p' "$job/.hydra/overrides.yaml" | tr -d "'\"")
        done=$([ -f "$job/metrics.json" ] && echo yes || echo no)
        failed=$(grep -E '^[A-Za-z_.]*(Error|Exception)' "$job/FAILED" 2>/dev/null | tail -n 1 | grep . || echo no)
        printf '%s  metrics.json: %s  FAILED: %s\n' "$row" "$done" "$failed"
        grep -h 'going on from step' "$job/run.log" | sed 's/.*\(going on from step [0-9]*\).*/    \1/' || true
    done
    cat "$STATE/sweep/table.md"
}

# The sweep under a heading, with what became of the jobs as they end.
sweep_through() {
    echo "== $1" && sweep | grep -E '#[0-9]+ (done|died|FAILED|has)' | cut -c 1-100 || true
}
