#include "threads.h"

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

namespace catacaustics {
namespace {

// Denormals cost hundreds of cycles each and are worth nothing in an image.
class FlushDenormals {
#if defined(__SSE2__)
    unsigned saved_ = _mm_getcsr();

   public:
    FlushDenormals() { _mm_setcsr(saved_ | 0x8040); }
    ~FlushDenormals() { _mm_setcsr(saved_); }
#elif defined(__aarch64__)
    uint64_t saved_;

   public:
    FlushDenormals() {
        asm volatile("mrs %0, fpcr" : "=r"(saved_));
        asm volatile("msr fpcr, %0" ::"r"(saved_ | (1u << 24)));
    }
    ~FlushDenormals() { asm volatile("msr fpcr, %0" ::"r"(saved_)); }
#endif
};

void relax() {
#if defined(__SSE2__)
    _mm_pause();
#endif
}

struct Job {
    TaskFunction run;
    void* context;
    int64_t tasks;
    std::atomic<int64_t> next{0};
    std::atomic<bool> out_of_memory{false};

    void work() {
        FlushDenormals flush;
        try {
            for (int64_t task; (task = next.fetch_add(1, std::memory_order_relaxed)) < tasks;) run(context, task);
        } catch (const std::bad_alloc&) {
            out_of_memory = true;
            next = tasks;
        }
    }
};

class Pool {
   public:
    const pid_t process = getpid();

    // False where another thread uses the pool: the caller then works alone.
    bool run(Job& job, int helpers) {
        std::unique_lock<std::mutex> turn(turn_, std::try_to_lock);
        if (!turn.owns_lock()) return false;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            try {
                for (; started_ < helpers; ++started_)
                    std::thread(&Pool::serve, this, generation_.load()).detach();
            } catch (const std::system_error&) {
                helpers = started_;  // the system gives no more threads: go on with those there are
            }
            job_ = &job;
            places_ = helpers;
            generation_.fetch_add(1);
        }
        wake_.notify_all();
        job.work();
        {
            // Helpers that have not come by now are not waited for: on a busy machine that takes milliseconds.
            std::lock_guard<std::mutex> lock(mutex_);
            job_ = nullptr;
        }
        for (int spin = 0; spin < kSpins && running_.load() > 0; ++spin) relax();
        std::unique_lock<std::mutex> lock(mutex_);
        done_.wait(lock, [&] { return running_.load() == 0; });
        return true;
    }

   private:
    static constexpr int kSpins = 2000;

    void serve(uint64_t seen) {
        for (;;) {
            for (int spin = 0; spin < kSpins && generation_.load() == seen; ++spin) relax();
            Job* job;
            {
                std::unique_lock<std::mutex> lock(mutex_);
                wake_.wait(lock, [&] { return generation_.load() != seen; });
                seen = generation_.load();
                if (!job_ || places_ == 0) continue;
                --places_;
                running_.fetch_add(1);
                job = job_;
            }
            job->work();
            std::lock_guard<std::mutex> lock(mutex_);
            if (running_.fetch_sub(1) == 1) done_.notify_one();
        }
    }

    std::mutex turn_, mutex_;
    std::condition_variable wake_, done_;
    std::atomic<uint64_t> generation_{0};
    std::atomic<int> running_{0};
    int started_ = 0, places_ = 0;
    Job* job_ = nullptr;
};

// Never destroyed: threads sleep in it until the process ends. A forked child has none of them and makes its own;
// without a lock, which another thread might have held as the process forked.
Pool& pool() {
    static std::atomic<Pool*> instance{nullptr};
    Pool* known = instance.load();
    if (known && known->process == getpid()) return *known;
    Pool* const own = new Pool;
    if (instance.compare_exchange_strong(known, own)) return *own;
    delete own;  // another thread was first
    return *known;
}

}  // namespace

void run_tasks(int threads, int64_t tasks, TaskFunction run, void* context) {
    Job job;
    job.run = run;
    job.context = context;
    job.tasks = tasks;
    const int helpers = int(threads < tasks ? threads : tasks) - 1;
    if (helpers <= 0 || !pool().run(job, helpers)) job.work();
    if (job.out_of_memory) throw std::bad_alloc();
}

}  // namespace catacaustics
