#include "engine.h"

#include <dlfcn.h>

namespace torcs::scr {

// Its library keeps its symbols to itself, but says where it is.
SimulatedCar** simulated_cars(const Simulation& simulation) {
    Dl_info info{};
    dladdr(reinterpret_cast<void*>(simulation.update), &info);
    void* library = dlopen(info.dli_fname, RTLD_NOW | RTLD_NOLOAD);
    if (!library) return nullptr;
    void* cars = dlsym(library, "SimCarTable");
    dlclose(library);
    return static_cast<SimulatedCar**>(cars);
}

}  // namespace torcs::scr
