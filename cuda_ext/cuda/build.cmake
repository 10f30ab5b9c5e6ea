# Runs nvcc; where it fails, leaves a line that says why instead of a library.
file(REMOVE ${library} ${failure})
execute_process(
  COMMAND ${nvcc} -shared -cudart static -std=c++17 -O3 -Xcompiler=-fPIC,-fvisibility=hidden --threads 0
          "-gencode=arch=compute_80,code=[${codes}]"
          "-DCATACAUSTICS_ARCHS=${archs}" ${sources} -o ${library}
  RESULT_VARIABLE status
  OUTPUT_VARIABLE output
  ERROR_VARIABLE output)
if(NOT status EQUAL 0)
  string(REGEX MATCH "[^\n]*(error|fatal|not found|No such)[^\n]*" reason "${output}")
  if(NOT reason)
    set(reason "nvcc ended with ${status}")
  endif()
  file(WRITE ${failure} "${reason}\n")
  message("The GPU's library was not built: ${reason}")
endif()
file(TOUCH ${stamp})
