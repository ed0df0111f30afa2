#!/bin/sh
# Our own entries, evaluated as anyone's: run from the repository's root (sh results/board/ours.sh).
set -e
work=$(mktemp -d)
for scenario in paper fouled; do
  for entry in tuned pi learnt; do
    case $entry-$scenario in
      learnt-paper) controller=results/starts/clean.toml ;;
      learnt-fouled) controller=results/starts/fouled.toml ;;
      *) controller=$entry ;;
    esac
    here=results/board/$entry-$scenario
    mkdir -p "$work/$here" "$here/runs"
    for seed in 3000000 3000001 3000002 3000003 3000004; do
      cosim simulate --scenario $scenario --controller $controller --steps 2000 --seed $seed --out "$work/run"
      cut -d, -f2-5 "$work/run/trajectory.csv" > "$work/$here/run-$seed.csv"
    done
    cosim evaluate --scenario $scenario --trajectories "$work/$here" --out "$work/judged"
    cp "$work/judged/judged.csv" "$here"
    cp "$work/$here/run-3000000.csv" "$here/runs"
  done
done
cosim results board
