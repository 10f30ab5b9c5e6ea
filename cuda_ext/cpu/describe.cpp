// Compiled for the plainest processor of the platform, so that it can be called before it is known which one this is.
#include "../abi.h"

CATACAUSTICS_EXPORT int64_t catacaustics_abi() { return catacaustics::kAbi; }

CATACAUSTICS_EXPORT const char* catacaustics_description() {
    return CATACAUSTICS_ARCH ", " CATACAUSTICS_COMPILER;
}

// Why this processor or system cannot run the library; empty where it can.
CATACAUSTICS_EXPORT const char* catacaustics_problem() {
    bool ok = true;
#if CATACAUSTICS_LEVEL >= 2
    __builtin_cpu_init();
    ok = __builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt");
#if CATACAUSTICS_LEVEL >= 3
    ok = ok && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2");
#endif
#if CATACAUSTICS_LEVEL >= 4
    ok = ok && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#endif
#endif
    return ok ? "" : "needs instructions that this processor lacks";
}
