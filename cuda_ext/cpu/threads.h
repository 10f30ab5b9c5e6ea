// One pool of threads for the library. Every task writes only its own results, so these do not depend on the threads.
#pragma once

#include <cstdint>
#include <type_traits>

namespace catacaustics {

using TaskFunction = void (*)(void* context, int64_t task);

// Calls run(context, task) for every task in [0, tasks) on up to `threads` threads, the caller's among them, with
// denormal numbers flushed to zero. Throws std::bad_alloc where a task ran out of memory.
void run_tasks(int threads, int64_t tasks, TaskFunction run, void* context);

template <class F>
void parallel_for(int threads, int64_t tasks, F&& function) {
    using Function = typename std::remove_reference<F>::type;
    run_tasks(
        threads, tasks, [](void* context, int64_t task) { (*static_cast<Function*>(context))(task); }, &function);
}

}  // namespace catacaustics
