// Shows that code does not allocate: counts this thread's calls of malloc, calloc, realloc, reallocarray,
// posix_memalign, aligned_alloc, memalign, valloc and every operator new, in any build type, by taking the
// allocator's place in the executable. In a CMakeLists.txt: intabs_test(tick SOURCES tick_test.cc LIBS
// intabs::nn intabs_alloc_hook)
//
//   #include "common/alloc_hook.h"
//   TEST_CASE("The tick does not allocate") {
//     if (!intabs::AllocationHookActive()) { WARN("skipped: sanitizers own the allocator"); return; }
//     REQUIRE(intabs::AllocationHookSeesAll());   // positive control: each kind of allocation is counted
//     const intabs::AllocationCounter counter;
//     for (int i = 0; i < 1000; ++i) Tick();
//     const auto n = counter.count();             // read it before REQUIRE, which allocates itself
//     REQUIRE(n == 0);
//   }
//
// Frees are not counted. Other threads' allocations are not seen: count in the thread that runs the code.
#pragma once

#include <cstdint>

namespace intabs {

// False in a sanitizer build, where the counter stays at 0.
bool AllocationHookActive();

// Allocates once in each way on this thread and tells whether each was counted.
bool AllocationHookSeesAll();

// Allocations of the calling thread since its construction.
class AllocationCounter {
 public:
  AllocationCounter();
  int64_t count() const;

 private:
  int64_t start_;
};

}  // namespace intabs
