#include "launch.h"

#define CATACAUSTICS_TEXT_OF(x) #x
#define CATACAUSTICS_TEXT(x) CATACAUSTICS_TEXT_OF(x)
#define CATACAUSTICS_CUDA CATACAUSTICS_TEXT(__CUDACC_VER_MAJOR__) "." CATACAUSTICS_TEXT(__CUDACC_VER_MINOR__)

namespace catacaustics {
namespace {

__global__ void probe() {}

}  // namespace

CATACAUSTICS_EXPORT int64_t catacaustics_abi() { return kAbi; }

CATACAUSTICS_EXPORT const char* catacaustics_description() {
    return CATACAUSTICS_TEXT(CATACAUSTICS_ARCHS) ", CUDA " CATACAUSTICS_CUDA;
}

// The last error; before any, why this system cannot run the library; empty where it can.
CATACAUSTICS_EXPORT const char* catacaustics_problem() {
    if (*last_error()) return last_error();
    int devices = 0;
    cudaFuncAttributes attributes;
    cudaError_t status = cudaGetDeviceCount(&devices);
    if (status == cudaSuccess) status = devices ? cudaFuncGetAttributes(&attributes, probe) : cudaErrorNoDevice;
    cudaGetLastError();
    return status == cudaSuccess ? "" : cudaGetErrorString(status);
}

}  // namespace catacaustics
