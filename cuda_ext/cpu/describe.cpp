// Compiled for the plainest processor of the platform, so that it can be called before it is known which one this is.
#include <cstdint>

#define CATACAUSTICS_EXPORT extern "C" __attribute__((visibility("default")))

// Bumped with every change of the ABI.
CATACAUSTICS_EXPORT int64_t catacaustics_abi() { return 1; }

CATACAUSTICS_EXPORT const char* catacaustics_description() {
    return CATACAUSTICS_ARCH ", " CATACAUSTICS_COMPILER;
}

// Whether this processor and system can run the library.
CATACAUSTICS_EXPORT int64_t catacaustics_supported() {
#if CATACAUSTICS_LEVEL >= 2
    __builtin_cpu_init();
    bool ok = __builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt");
#if CATACAUSTICS_LEVEL >= 3
    ok = ok && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2");
#endif
#if CATACAUSTICS_LEVEL >= 4
    ok = ok && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#endif
    return ok;
#else
    return 1;
#endif
}
