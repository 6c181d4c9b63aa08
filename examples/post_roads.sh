#!/bin/sh
# Make an agent like `ppo-post-roads`, which drives any road by the 29 numbers alone: a student of
# `ppo-any-road`, three agents that go on learning from it, and a student of these. At the end it
# drives all roads and ovals. It takes two cores about an hour.
set -e
export OMP_NUM_THREADS=1

made=logs/post-roads
tracks="aalborg brondehach corkscrew e-track-1 eroad g-track-3 ole-road-1 ruudskogen spring wheel-2"

student() {
  python examples/distill.py --teach "$1" $tracks --cars 12 --rounds 60 --mirror --grip 0.9 \
    --actor-sensors base --folder "$2"
}

go_on() {
  python examples/specialize.py $made/first/model.zip --together --track $tracks --seed "$1" \
    --timesteps 6000000 --folder $made/"$1"
}

student ppo-any-road $made/first
go_on 0 &
go_on 1
go_on 2
wait
student $made/0/together.zip,$made/1/together.zip,$made/2/together.zip $made/last

echo "learned:"
python examples/evaluate_tracks.py $made/last/model.zip --track $tracks
echo "never seen:"
python examples/evaluate_tracks.py $made/last/model.zip --track road --without $tracks
echo "ovals:"
python examples/evaluate_tracks.py $made/last/model.zip --track oval
