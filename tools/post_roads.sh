#!/bin/sh
# Make three agents like `ppo-post-roads`, which drives roads that it never saw by the 29 numbers
# alone: a student of `ppo-any-road`, and what three seeds of PPO make of it. At the end they drive
# all roads and ovals. It takes two cores an hour and a quarter.
set -e
export OMP_NUM_THREADS=1

made=logs/post-roads
tracks="aalborg brondehach corkscrew e-track-1 eroad g-track-3 ole-road-1 ruudskogen spring wheel-2"

go_on() {
  python examples/specialize.py $made/student/model.zip --together --track $tracks --seed "$1" \
    --timesteps 8000000 --folder $made/"$1"
}

python examples/distill.py --teach ppo-any-road $tracks --cars 40 --rounds 150 --mirror --grip 0.9 \
  --actor-sensors base --folder $made/student
go_on 0 &
go_on 1
go_on 2
wait

echo "learned:"
python examples/evaluate_tracks.py $made/[012]/together.zip --track $tracks
echo "never seen:"
python examples/evaluate_tracks.py $made/[012]/together.zip --track road --without $tracks
echo "ovals:"
python examples/evaluate_tracks.py $made/[012]/together.zip --track oval
