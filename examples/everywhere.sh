#!/bin/sh
# Make the agent `ppo-everywhere`: 17 specialists, then a student of them and of those they come
# from. It takes two cores half an hour.
set -e
export OMP_NUM_THREADS=1

special() {
  python examples/specialize.py "$@" --folder logs/specialists
}

special ppo-roads --track aalborg brondehach corkscrew e-track-2 e-track-3 eroad forza g-track-1 &
special ppo-roads --track g-track-2 g-track-3 ruudskogen wheel-1 wheel-2 b-speedway
special ppo-roads --track street-1 --seed 1 # that of seed 0 leaves the road
special ppo-ole-road-1 --track ole-road-1
special ppo-dirt --track dirt-6
wait

# Who is named more than once gets more cars: those tracks are hard for the student.
taught="" thrice="g-speedway g-speedway g-speedway"
for track in aalborg b-speedway brondehach corkscrew dirt-6 e-track-2 e-track-3 eroad forza \
  g-track-1 g-track-2 g-track-3 ole-road-1 ruudskogen street-1 wheel-1 wheel-2; do
  taught="$taught --teach logs/specialists/$track.zip $track"
  case $track in
    b-speedway) taught="$taught c-speedway d-speedway e-speedway f-speedway $thrice" ;;
    e-track-2 | ole-road-1 | dirt-6) taught="$taught $track" ;;
  esac
done
python examples/distill.py $taught \
  --teach ppo-roads spring spring alpine-1 alpine-1 alpine-2 e-track-1 e-track-4 e-track-6 \
  e-track-6 a-speedway e-track-5 michigan \
  --teach ppo-dirt dirt-1 dirt-3 dirt-3 dirt-3 dirt-4 dirt-5 mixed-1 mixed-2 \
  --rounds 300 --folder logs/everywhere
