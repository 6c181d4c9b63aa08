#!/bin/sh
# Make an agent like `ppo-everywhere`: 22 specialists, then a student of them and of those they come
# from. It takes two cores about an hour.
# shellcheck disable=SC2046  # each word is an argument
set -e
export OMP_NUM_THREADS=1

# Four of its teachers are no longer in the package; this commit has them.
retired=logs/retired
mkdir -p $retired
git archive 70f23c0 sb3_torcs/agents | tar -x -C $retired --strip-components 2
roads=$retired/ppo-roads/best_model.zip
dirt=$retired/ppo-dirt/best_model.zip
dirt_2=$retired/ppo-dirt-2/best_model.zip
ole_road_1=$retired/ppo-ole-road-1/best_model.zip

special() {
  python examples/specialize.py "$@" --folder logs/specialists
}

special $roads --track aalborg alpine-1 alpine-2 brondehach corkscrew e-track-2 e-track-3 \
  e-track-4 e-track-6 eroad forza &
special $roads --track g-track-1 g-track-2 g-track-3 ruudskogen wheel-1 wheel-2 b-speedway
special $roads --track e-track-1 street-1 --seed 1 # those of seed 0 leave the road
special $ole_road_1 --track ole-road-1
special $dirt --track dirt-6
wait

# Each word is the track of a specialist, and after colons come the others on which it teaches. A
# track that is named more than once gets more cars.
from_specialists() {
  for word in "$@"; do
    echo --teach "logs/specialists/${word%%:*}.zip" $(echo "$word" | tr : ' ')
  done
}

ovals=b-speedway:c-speedway:d-speedway:e-speedway:f-speedway:g-speedway

python examples/distill.py --rounds 200 --folder logs/first $(
  from_specialists aalborg alpine-1:alpine-1 alpine-2 $ovals brondehach corkscrew dirt-6:dirt-6 \
    e-track-1 e-track-2 e-track-3 e-track-4:e-track-4 e-track-6 eroad forza g-track-1 g-track-2 \
    g-track-3 ole-road-1:ole-road-1 ruudskogen street-1 wheel-1 wheel-2
) --teach $roads spring spring a-speedway e-track-5 michigan --teach $dirt dirt-1 dirt-3 \
  dirt-4 dirt-5 mixed-1 mixed-2 --teach $dirt_2 dirt-2 dirt-2 dirt-2 dirt-2

# More cars where that student leaves the road.
python examples/distill.py --student logs/first/model.zip --rounds 250 --folder logs/second $(
  from_specialists aalborg alpine-1:alpine-1:alpine-1 alpine-2 $ovals brondehach corkscrew \
    dirt-6:dirt-6:dirt-6 e-track-1 e-track-2:e-track-2:e-track-2 e-track-3 \
    e-track-4:e-track-4:e-track-4 e-track-6:e-track-6:e-track-6 eroad forza g-track-1 g-track-2 \
    g-track-3 ole-road-1:ole-road-1:ole-road-1 ruudskogen street-1 wheel-1 wheel-2
) --teach $roads spring spring a-speedway e-track-5 michigan --teach $dirt dirt-1 dirt-3 \
  dirt-3 dirt-3 dirt-4 dirt-5 mixed-1 mixed-2

# `ppo-roads` teaches where a specialist takes damage, or its student leaves the road.
python examples/distill.py --student logs/second/model.zip --rounds 140 --folder logs/everywhere $(
  from_specialists aalborg $ovals:g-speedway brondehach corkscrew dirt-6:dirt-6 \
    e-track-2:e-track-2 e-track-3 eroad forza g-track-1 g-track-2 g-track-3 \
    ole-road-1:ole-road-1 ruudskogen street-1 wheel-1 wheel-2
) --teach $roads spring spring alpine-1 alpine-1 alpine-2 e-track-1 e-track-4 e-track-6 \
  e-track-6 a-speedway e-track-5 michigan --teach $dirt dirt-1 dirt-3 dirt-3 dirt-3 dirt-4 \
  dirt-5 mixed-1 mixed-2
