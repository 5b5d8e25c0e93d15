#!/usr/bin/env bash
# Runs the benchmarks, refinement and films on both devices, both trainings and an evaluation of the new weights on a GPU.
#
#   OUT=results bash assets/recipe/homes/gpu.sh [truth|devices|training|judge ...]     all parts by default
#
# SIZE=tiny runs each part with tiny sizes, also on a processor (DEVICE=cpu): try that before. Each part has its own
# limit; one that fails or runs out of time leaves what it has in $OUT, and the next one starts. SHARED is the folder
# with the real panoramas. Training goes on from $OUT/sharpening and $OUT/depth if they are there.
set -uo pipefail
cd "$(dirname "$0")/../../.."

OUT=${OUT:?needed the folder for the results}
SIZE=${SIZE:-full} DEVICE=${DEVICE:-cuda} SHARED=${SHARED:-../shared} CORES=$(nproc)
FURNITURE=/usr/share/sweethome3d/furniture
bin=.venv/bin
mkdir -p "$OUT"
OUT=$(realpath "$OUT")

if [ "$SIZE" = tiny ]; then
    limits=(1200 600 400 1800) film=.2 refined=4 homes=16 height=64 rows=128 steps=2 minutes=2 quick=--quick pairs=1 workers=0 real=
else
    limits=(180 480 120 480) film=4 refined=40 homes=1600 height=256 rows=512 steps=1500 minutes=1.2 quick= pairs=16 workers=8 real=$SHARED/data/zind
fi
[ -d "$FURNITURE" ] && furniture="--furniture $FURNITURE" || furniture=

step() { # limit in seconds, name, command...
    local limit=$1 name=$2
    shift 2
    printf '== %s\n' "$name"
    local began=$SECONDS
    timeout -k 10 "$limit" "$@" >> "$OUT/$name.log" 2>&1 || printf '%s: exit status %s, see %s.log\n' "$name" $? "$name"
    echo $((SECONDS - began)) > "$OUT/$name.seconds"
}

truth() {
    local each=$((limits[0] / 4)) suite
    [ "$DEVICE" = cuda ] && step $each triton env TRITON_INTERPRET=0 $bin/pytest -q -m "exhaustive or not exhaustive" tests/rendering/cuda
    for suite in raster model viewer; do step $each $suite $bin/pansplat bench $suite $quick --overwrite --out "$OUT"; done
}

# Refinement for equal steps and for 10 s, and a film, on each device: time beside error, in devices.md.
devices() {
    local each=$((limits[3] / 6)) names=cpu name
    [ "$DEVICE" = cuda ] && names="cuda cpu"
    for name in $names; do
        local common=(assets/living_room --device "$name" --verbose --overwrite)
        step $each "steps-$name" $bin/pansplat refine "${common[@]}" --layers --height $rows --steps $refined \
            -o "$OUT/steps-$name.ply"
        step $each "seconds-$name" $bin/pansplat refine "${common[@]}" --layers --height $rows --steps 400 --seconds 10 \
            -o "$OUT/seconds-$name.ply"
        step $each "film-$name" $bin/pansplat render "${common[@]}" --predict-height $rows --refine 0 --seconds $film \
            -o "$OUT/film-$name.mp4"
    done
    $bin/python assets/recipe/homes/devices.py "$OUT" > "$OUT/devices.md" && cat "$OUT/devices.md"
}

# The cores of the processor make homes while the device trains; each round reads those that are there.
training() {
    local end name rows_of start
    for name in sharpening depth; do
        end=$((SECONDS + limits[1] / 2)) rows_of=$height start=assets/default/model.safetensors
        [ $name = sharpening ] && rows_of=$((height * 3 / 2)) start=assets/default/sharpening.safetensors
        # shellcheck disable=SC2086  # two words or none
        timeout $((limits[1] / 2)) $bin/pansplat-homes homes -o "$OUT/homes_$name" --count $homes --seed 7000 \
            --height $rows_of --workers "$CORES" $furniture > "$OUT/homes_$name.log" 2>&1 &
        until ls "$OUT/homes_$name"/shard_* > /dev/null 2>&1 || ! kill -0 $! 2> /dev/null; do sleep 1; done
        while [ $((end - SECONDS)) -gt 20 ]; do
            step $((end - SECONDS)) train-$name $bin/pansplat-homes train-$name --out "$OUT/$name" --tours "$OUT/homes_$name" \
                --device "$DEVICE" --pairs $pairs --workers $workers --steps $steps --decay-steps $((steps / 2)) --warm-up 1 \
                --stop-after-minutes $minutes --minutes 1 --init $start
            [ "$SIZE" = tiny ] && break
        done
        kill $! 2> /dev/null
    done
}

judge() {
    local model name
    for model in default "$OUT/depth/model.safetensors"; do
        name=judge-default
        [ "$model" = default ] || name=judge-depth
        step $((limits[2] / 2)) "$name" $bin/pansplat evaluate assets/living_room $real --model "$model" --height $rows \
            --overwrite --out "$OUT/$name"
    done
}

for part in "${@:-truth devices training judge}"; do
    for name in $part; do $name; done
done
ls -R "$OUT" | tail -40
