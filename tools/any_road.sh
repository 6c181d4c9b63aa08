#!/bin/sh
# Make five agents like `ppo-any-road`: fifteen trainings on ten tracks, and a student of each three
# of them. At the end the students drive all roads and ovals. It takes two cores about two hours.
set -e
export OMP_NUM_THREADS=1

trained=logs/studies/open-roads
tracks="aalborg brondehach corkscrew e-track-1 eroad g-track-3 ole-road-1 ruudskogen spring wheel-2"

model() {
  echo "$trained/default-seed$1/best_model.zip"
}

sb3-torcs study examples/studies/open_roads.yml --folder $trained
for student in 0 1 2 3 4; do
  first=$((3 * student))
  teachers=$(model $first),$(model $((first + 1))),$(model $((first + 2)))
  python examples/distill.py --teach "$teachers" $tracks --cars 12 --rounds 60 --mirror --grip 0.9 \
    --seed $student --folder logs/any-road/$student
done

echo "learned:"
python examples/evaluate_tracks.py logs/any-road/*/model.zip --track $tracks
echo "never seen:"
python examples/evaluate_tracks.py logs/any-road/*/model.zip --track road --without $tracks
echo "ovals:"
python examples/evaluate_tracks.py logs/any-road/*/model.zip --track oval
