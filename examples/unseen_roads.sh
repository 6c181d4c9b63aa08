#!/bin/sh
# Make an agent for roads that it never saw: two trainings on ten tracks, then a student of the mean
# of what both would do. The first argument is its seed, by default 0. It takes two cores about a
# quarter of an hour.
set -e
export OMP_NUM_THREADS=1
seed=${1:-0}

learn() {
  sb3-torcs train --algo ppo --env Torcs-v0 --entry roads --timesteps 6291456 --eval-freq 0 \
    --seed "$1" --folder "logs/roads-$1"
}

learn $((2 * seed)) &
learn $((2 * seed + 1))
wait

teacher() {
  echo "logs/roads-$1/ppo/Torcs-v0_1/Torcs-v0.zip"
}

python examples/distill.py --teach "$(teacher $((2 * seed))),$(teacher $((2 * seed + 1)))" \
  aalborg alpine-1 corkscrew e-track-1 e-track-3 ole-road-1 street-1 wheel-2 eroad brondehach \
  --cars 12 --rounds 60 --mirror --grip 0.85 --seed "$seed" --folder "logs/unseen-$seed"
