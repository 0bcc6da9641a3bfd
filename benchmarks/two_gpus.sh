#!/usr/bin/env bash
# Trains on one and on two GPUs with the same total of environments and transitions, and compares.
# From the project root, PYTHONPATH set:  two_gpus.sh [NUM_ENVS] [TRANSITIONS] [more options of train ...]
# PARTS="1 2" runs only these (default: 1 2 3 4 5). PYTHON names the interpreter, TWO_GPUS_OUT the folder of the runs.
set -uo pipefail
NUM_ENVS=${1:-8192}; TRANSITIONS=${2:-20000000}; shift $(( $# < 2 ? $# : 2 ))
PYTHON=${PYTHON:-python}; OUT=$(mktemp -d "${TWO_GPUS_OUT:-${TMPDIR:-/tmp}}/two_gpus.XXXXXX")
TORCHRUN="$PYTHON -m torch.distributed.run --standalone --nproc-per-node 2"
TRAIN="pixel2catch train proposed --device cuda --num-envs $NUM_ENVS --transitions $TRANSITIONS $*"
failed=0
is_asked() { [[ " ${PARTS:-1 2 3 4 5} " == *" $1 "* ]]; }
check() { if eval "$2"; then echo "ok:   $1"; else echo "FAIL: $1"; failed=1; fi; }

if is_asked 1; then
echo "== 1. Laws on two devices: NCCL inside the captured step, equal networks, joint statistics"
timeout 200 $PYTHON -m pytest -o addopts="" tests/learning -q -m "gpu or not slow" -k learn_as_one 2>&1 | tail -15
check "laws (2 passed on cuda, none skipped)" "[ ${PIPESTATUS[0]} = 0 ]"
fi

if is_asked 2; then
echo "== 2. One GPU, then two: $NUM_ENVS environments, $TRANSITIONS transitions"
time timeout 590 $PYTHON -m $TRAIN --out "$OUT/one" | tail -3; check "one GPU ends with 0" "[ ${PIPESTATUS[0]} = 0 ]"
time timeout 590 $TORCHRUN -m $TRAIN --out "$OUT/two" 2>&1 | tail -5
check "two GPUs end with 0 (124: it hangs, look at the end of the process group)" "[ ${PIPESTATUS[0]} = 0 ]"
check "one event file, one policy" "[ \$(ls $OUT/two/events* | wc -l) = 1 ] && [ -f $OUT/two/policy/policy.json ]"
$PYTHON - "$OUT/one" "$OUT/two" <<'PY'
import csv, json, statistics, sys
from pathlib import Path
runs = {Path(p).name: list(csv.DictReader(open(Path(p) / "metrics.csv"))) for p in sys.argv[1:]}
def median(rows, name): return statistics.median(float(r[name]) for r in rows[len(rows) // 4:])
for name, rows in runs.items():
    rate, roll, up = (median(rows, n) for n in ("transitions_per_second", "rollout_seconds", "update_seconds"))
    session = json.loads((Path(sys.argv[1]).parent / name / "sessions.json").read_text())[-1]
    print(f"{name}: {session['processes']} process(es), {rate / 1e3:.1f} k transitions/s, rollout {1e3 * roll:.0f} ms, update {1e3 * up:.0f} ms")
a, b = (median(runs[n], "transitions_per_second") for n in ("one", "two"))
print(f"speed-up {b / a:.2f}")
print("success rate (episodes) by transitions, mean of ten bins:   one        two")
end = float(runs["one"][-1]["transitions"])
def pooled(rows, low, high):
    part = [r for r in rows if low < float(r["transitions"]) <= high and float(r["episodes"] or 0) > 0]
    n = sum(float(r["episodes"]) for r in part)
    return (sum(float(r["success_rate"]) * float(r["episodes"]) for r in part) / n if n else float("nan")), n
for k in range(10):
    cells = [pooled(rows, k * end / 10, (k + 1) * end / 10) for rows in runs.values()]
    print(f"{(k + 1) * end / 10 / 1e6:8.2f} M  " + "   ".join(f"{100 * r:5.1f} % ({n:.0f})" for r, n in cells))
PY
fi

if is_asked 3; then
echo "== 3. Ctrl-C at torchrun, then one GPU resumes what two have written"
$TORCHRUN -m $TRAIN --transitions 1000000000 --out "$OUT/stop" > "$OUT/stop.log" 2>&1 & pid=$!
for _ in $(seq 120); do grep -q "transitions ·" "$OUT/stop.log" && break; sleep 1; done
sleep 3; kill -INT $pid; start=$SECONDS; wait $pid
check "interrupted within 25 s, told once" "[ $((SECONDS - start)) -lt 25 ] && [ \$(grep -c 'interrupted:' $OUT/stop.log) = 1 ]"
done_so_far=$($PYTHON -c "import json,sys; print(json.load(open(sys.argv[1]))['transitions'])" "$OUT/stop/summary.json")
timeout 200 $PYTHON -m $TRAIN --transitions $((done_so_far + 3 * NUM_ENVS * 16)) --resume --out "$OUT/stop" 2>&1 | tail -1
check "one GPU resumes a run of two" "[ ${PIPESTATUS[0]} = 0 ]"
fi

if is_asked 4; then
echo "== 4. Errors end all processes and are told once"
timeout 60 $TORCHRUN -m pixel2catch train proposed --device cuda --num-envs 7 --out "$OUT/odd" > "$OUT/odd.log" 2>&1
check "7 environments are refused once; no folder" "[ \$(grep -c 'num_envs is 7' $OUT/odd.log) = 1 ] && [ ! -e $OUT/odd ]"
timeout 60 $TORCHRUN -m $TRAIN --device cuda:1 --out "$OUT/odd" > "$OUT/odd.log" 2>&1
check "--device cuda:1 is refused" "grep -q \"use 'cuda'\" $OUT/odd.log && [ ! -e $OUT/odd ]"
timeout 120 $TORCHRUN -m $TRAIN --learning-rate 1e30 --final-learning-rate 1e30 --out "$OUT/nan" > "$OUT/nan.log" 2>&1; status=$?
grep "error:" "$OUT/nan.log" | head -3
check "NaN ends both within two minutes" "[ $status != 0 ] && [ $status != 124 ] && [ \$(grep -c 'pixel2catch: error' $OUT/nan.log) = 1 ]"
fi

if is_asked 5; then
echo "== 5. One process on the second device learns (torch's current device is set)"
timeout 200 $PYTHON -m $TRAIN --device cuda:1 --transitions $((4 * NUM_ENVS * 16)) --out "$OUT/second" 2>&1 | tail -1
check "cuda:1 ends with 0" "[ ${PIPESTATUS[0]} = 0 ]"
fi

ps -eo pid,args | grep "[p]ixel2catch train" && { echo "FAIL: processes are left"; failed=1; }
echo "runs and logs in $OUT"; exit $failed
