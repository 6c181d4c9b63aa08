// What the game's race engine exports to whoever is loaded into its process.
#pragma once

#include "../layout.h"

extern "C" torcs::RaceManager* ReInfo;

namespace torcs::scr {

void clean_race_up() asm("_Z13ReRaceCleanupv");
int prepare_race() asm("_Z9RePreRacev");
int start_race() asm("_Z11ReRaceStartv");
int set_text(void* params, const char* section, const char* name,
             const char* value) asm("_Z12GfParmSetStrPvPKcS1_S1_");
void to_global(TrackPosition*, float* x, float* y,
               int against) asm("_Z19RtTrackLocal2GlobalP10tTrkLocPosPfS1_i");
float road_height(TrackPosition*) asm("_Z14RtTrackHeightLP10tTrkLocPos");

// The simulation's own cars; null if it does not tell where they are.
SimulatedCar** simulated_cars(const Simulation& simulation);

constexpr int TEXT_MODE = 4;  // of RaceManager::display_mode

}  // namespace torcs::scr
