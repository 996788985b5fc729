#include "common/alloc_hook.h"

#include <malloc.h>

#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <new>

#if defined(__has_feature)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer) || __has_feature(memory_sanitizer)
#define INTABS_SANITIZED 1
#endif
#endif
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define INTABS_SANITIZED 1
#endif

namespace {
// In the executable's own thread storage: touching it does not allocate.
thread_local int64_t allocations = 0;
}  // namespace

#ifndef INTABS_SANITIZED
// glibc's allocator under its other names. operator new of libstdc++ calls malloc or aligned_alloc, so it is
// counted.
extern "C" {
void* __libc_malloc(size_t);
void* __libc_calloc(size_t, size_t);
void* __libc_realloc(void*, size_t);
void* __libc_memalign(size_t, size_t);

void* malloc(size_t size) {
  ++allocations;
  return __libc_malloc(size);
}
void* calloc(size_t n, size_t size) {
  ++allocations;
  return __libc_calloc(n, size);
}
void* realloc(void* p, size_t size) {
  ++allocations;
  return __libc_realloc(p, size);
}
void* reallocarray(void* p, size_t n, size_t size) {
  size_t bytes;
  if (__builtin_mul_overflow(n, size, &bytes)) {
    errno = ENOMEM;
    return nullptr;
  }
  return realloc(p, bytes);
}
void* memalign(size_t alignment, size_t size) {
  ++allocations;
  return __libc_memalign(alignment, size);
}
void* aligned_alloc(size_t alignment, size_t size) { return memalign(alignment, size); }
void* valloc(size_t size) { return memalign(4096, size); }
int posix_memalign(void** p, size_t alignment, size_t size) {
  if (alignment < sizeof(void*) || (alignment & (alignment - 1)) != 0) return EINVAL;
  *p = memalign(alignment, size);
  return *p ? 0 : ENOMEM;
}
}
#endif

namespace intabs {

bool AllocationHookActive() {
#ifdef INTABS_SANITIZED
  return false;
#else
  return true;
#endif
}

AllocationCounter::AllocationCounter() : start_(allocations) {}
int64_t AllocationCounter::count() const { return allocations - start_; }

bool AllocationHookSeesAll() {
  bool all = true;
  // The pointer goes through a volatile, so that the compiler cannot drop the pair of allocation and release.
  const auto once = [&](auto allocate, auto release) {
    const AllocationCounter counter;
    void* volatile p = allocate();
    all = all && p != nullptr && counter.count() == 1;
    release(p);
  };
  struct alignas(128) Wide {
    char c[128];
  };
  once([] { return std::malloc(10); }, std::free);
  once([] { return std::calloc(2, 10); }, std::free);
  once([] { return std::realloc(nullptr, 10); }, std::free);
  once([] { return reallocarray(nullptr, 2, 10); }, std::free);
  once([] { return std::aligned_alloc(64, 128); }, std::free);
  once([] { return memalign(64, 128); }, std::free);
  once([] { return valloc(128); }, std::free);
  once(
      []() -> void* {
        void* p = nullptr;
        return posix_memalign(&p, 64, 128) == 0 ? p : nullptr;
      },
      std::free);
  once([]() -> void* { return new int; }, [](void* p) { delete static_cast<int*>(p); });
  once([]() -> void* { return new int[7]; }, [](void* p) { delete[] static_cast<int*>(p); });
  once([]() -> void* { return new Wide; }, [](void* p) { delete static_cast<Wide*>(p); });
  once([]() -> void* { return new (std::nothrow) int; }, [](void* p) { delete static_cast<int*>(p); });
  return all;
}

}  // namespace intabs
