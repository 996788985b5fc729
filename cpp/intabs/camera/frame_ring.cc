#include "intabs/camera/frame_ring.h"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cstring>
#include <stdexcept>

namespace intabs {
namespace {

constexpr uint64_t kMagic = 0x32474e5246424149;  // "IABFRNG2": also the layout's version
constexpr size_t kNameSize = 32;
constexpr int64_t kMaxPixels = int64_t{1} << 26;
constexpr int kMaxSlots = 1024;

static_assert(std::atomic<int64_t>::is_always_lock_free);

struct Header {
  std::atomic<uint64_t> magic;  // written last
  int32_t num_cameras, width, height, slots, depth;
  char names[kMaxCameras][kNameSize];
  alignas(64) std::atomic<int64_t> newest[kMaxCameras];
};

// `version` is odd while the slot is being written, 0 before the first time.
struct alignas(64) Slot {
  std::atomic<int64_t> version, frame_seq, exposure_us;
};

// Layout: Header, Slot[cameras * slots], then for each slot its pixels and, where there is depth, its depths,
// both padded to whole words.
struct Layout {
  int num_cameras, width, height, slots;
  bool depth;
  static size_t Padded(size_t bytes) { return (bytes + 63) / 64 * 64; }
  size_t bytes() const { return size_t{3} * width * height; }
  size_t depth_bytes() const { return depth ? size_t{2} * width * height : 0; }
  size_t slot_bytes() const { return Padded(bytes()) + Padded(depth_bytes()); }
  size_t count() const { return size_t(num_cameras) * slots; }
  size_t total() const { return sizeof(Header) + count() * (sizeof(Slot) + slot_bytes()); }
};

// Seqlocks need their data to be atomic too (H.-J. Boehm, "Can seqlocks get along with programming language
// memory models?", 2012). Release stores and acquire loads of the words take the place of fences: who sees
// one word of a new picture also sees that the slot's version has changed.
void StoreWords(uint64_t* shared, const void* from, size_t bytes) noexcept {
  for (size_t i = 0; i < bytes; i += 8) {
    uint64_t word = 0;
    if (from) std::memcpy(&word, static_cast<const char*>(from) + i, std::min<size_t>(8, bytes - i));
    std::atomic_ref(shared[i / 8]).store(word, std::memory_order_release);
  }
}

void LoadWords(const uint64_t* shared, void* to, size_t bytes) noexcept {
  for (size_t i = 0; i < bytes; i += 8) {
    const uint64_t word =
        std::atomic_ref(const_cast<uint64_t&>(shared[i / 8])).load(std::memory_order_acquire);
    std::memcpy(static_cast<char*>(to) + i, &word, std::min<size_t>(8, bytes - i));
  }
}

std::runtime_error Error(const std::string& name, const std::string& what) {
  return std::runtime_error("frame ring \"" + name + "\": " + what);
}

struct Descriptor {
  explicit Descriptor(int d) : fd(d) {}
  ~Descriptor() { Close(); }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  void Close() {
    if (fd >= 0) close(fd);
    fd = -1;
  }
  int fd;
};

// A mapped ring.
struct Mapping {
  Mapping(void* base, const Layout& l) : memory(base), layout(l) {}
  ~Mapping() { munmap(memory, layout.total()); }
  Mapping(const Mapping&) = delete;
  Mapping& operator=(const Mapping&) = delete;

  Header& header() const { return *static_cast<Header*>(memory); }
  Slot& slot(size_t i) const {
    return reinterpret_cast<Slot*>(static_cast<char*>(memory) + sizeof(Header))[i];
  }
  uint64_t* pixels(size_t i) const {
    char* first = static_cast<char*>(memory) + sizeof(Header) + layout.count() * sizeof(Slot);
    return reinterpret_cast<uint64_t*>(first + i * layout.slot_bytes());
  }
  uint64_t* depths(size_t i) const { return pixels(i) + Layout::Padded(layout.bytes()) / 8; }
  size_t Index(int camera, int64_t frame_seq) const {
    return size_t(camera) * layout.slots + frame_seq % layout.slots;
  }

  void* memory;
  Layout layout;
};

// Takes away what a writer that is no more has left. The lock of a file ends with the process that holds it.
void RemoveStale(const std::string& name) {
  const Descriptor old(shm_open(name.c_str(), O_RDWR, 0));
  if (old.fd < 0) return;
  if (flock(old.fd, LOCK_EX | LOCK_NB) != 0) {
    throw Error(name, "another process writes it: stop that one, or give this one another name");
  }
  shm_unlink(name.c_str());
}

}  // namespace

struct FrameRingWriter::Map {
  Map(const std::string& n, int fd, void* base, const Layout& layout)
      : name(n), lock(fd), ring(base, layout) {}
  ~Map() { shm_unlink(name.c_str()); }

  const std::string name;
  const Descriptor lock;
  const Mapping ring;
};

FrameRingWriter::FrameRingWriter(const std::string& name, const std::vector<std::string>& cameras, int width,
                                 int height, int slots, bool depth) {
  const Layout layout{static_cast<int>(cameras.size()), width, height, slots, depth};
  if (cameras.empty() || cameras.size() > kMaxCameras) {
    throw Error(name,
                std::to_string(cameras.size()) + " cameras; it holds 1 to " + std::to_string(kMaxCameras));
  }
  if (width < 1 || height < 1 || int64_t{width} * height > kMaxPixels || slots < 1 || slots > kMaxSlots) {
    throw Error(name, "cannot hold " + std::to_string(slots) + " slots of " + std::to_string(width) + "x" +
                          std::to_string(height));
  }
  for (const std::string& c : cameras) {
    if (c.empty() || c.size() >= kNameSize)
      throw Error(name, "camera name \"" + c + "\" must have 1 to 31 bytes");
  }

  RemoveStale(name);
  Descriptor fd(shm_open(name.c_str(), O_CREAT | O_EXCL | O_RDWR, 0600));
  if (fd.fd < 0) throw Error(name, std::string("cannot be made: ") + std::strerror(errno));
  void* base = MAP_FAILED;
  // posix_fallocate, not ftruncate: where /dev/shm is too small we hear of it now, not by a SIGBUS later.
  int fault = flock(fd.fd, LOCK_EX | LOCK_NB) == 0
                  ? posix_fallocate(fd.fd, 0, static_cast<off_t>(layout.total()))
                  : errno;
  if (fault == 0) {
    base = mmap(nullptr, layout.total(), PROT_READ | PROT_WRITE, MAP_SHARED, fd.fd, 0);
    if (base == MAP_FAILED) fault = errno;
  }
  if (fault != 0) {
    shm_unlink(name.c_str());
    throw Error(name, std::to_string(layout.total() >> 20) +
                          " MiB of shared memory are not to be had (/dev/shm): " + std::strerror(fault));
  }
  map_ = std::make_unique<Map>(name, fd.fd, base, layout);
  fd.fd = -1;  // handed over
  Header& h = map_->ring.header();
  h.num_cameras = layout.num_cameras;
  h.width = width;
  h.height = height;
  h.slots = slots;
  h.depth = layout.depth;
  for (size_t i = 0; i < cameras.size(); ++i) std::strcpy(h.names[i], cameras[i].c_str());
  h.magic.store(kMagic, std::memory_order_release);
}

FrameRingWriter::~FrameRingWriter() = default;

void FrameRingWriter::Write(int camera, int64_t frame_seq, int64_t exposure_us, const uint8_t* rgb,
                            const uint16_t* depth) noexcept {
  const Mapping& ring = map_->ring;
  if (camera < 0 || camera >= ring.layout.num_cameras || frame_seq < 1) return;
  const size_t i = ring.Index(camera, frame_seq);
  Slot& slot = ring.slot(i);
  const int64_t version = slot.version.load(std::memory_order_relaxed);
  slot.version.store(version + 1, std::memory_order_relaxed);
  slot.frame_seq.store(frame_seq, std::memory_order_release);
  slot.exposure_us.store(exposure_us, std::memory_order_release);
  StoreWords(ring.pixels(i), rgb, ring.layout.bytes());
  StoreWords(ring.depths(i), depth, ring.layout.depth_bytes());
  slot.version.store(version + 2, std::memory_order_release);
  ring.header().newest[camera].store(frame_seq, std::memory_order_release);
}

struct FrameRingReader::Map : Mapping {
  Map(const std::string& n, ino_t i, void* base, const Layout& layout)
      : Mapping(base, layout), name(n), inode(i) {}
  const std::string name;
  const ino_t inode;
};

FrameRingReader::FrameRingReader(const std::string& name) {
  const Descriptor fd(shm_open(name.c_str(), O_RDONLY, 0));
  if (fd.fd < 0) {
    throw Error(name, errno == ENOENT
                          ? "there is none: start the plant or a camera first, with the same ring name"
                          : std::string("cannot be opened: ") + std::strerror(errno));
  }
  struct stat file;
  if (fstat(fd.fd, &file) != 0) throw Error(name, std::strerror(errno));
  const size_t size = static_cast<size_t>(file.st_size);
  const std::string unreadable = "is not (yet) a ring that this program can read";
  if (size < sizeof(Header)) throw Error(name, unreadable);

  void* base = mmap(nullptr, size, PROT_READ, MAP_SHARED, fd.fd, 0);
  if (base == MAP_FAILED) throw Error(name, std::string("cannot be mapped: ") + std::strerror(errno));
  const Header& h = *static_cast<const Header*>(base);
  const bool ready = h.magic.load(std::memory_order_acquire) == kMagic;
  const Layout layout{h.num_cameras, h.width, h.height, h.slots, h.depth != 0};
  const bool sane = ready && layout.num_cameras >= 1 && layout.num_cameras <= kMaxCameras &&
                    layout.width >= 1 && layout.height >= 1 &&
                    int64_t{layout.width} * layout.height <= kMaxPixels && layout.slots >= 1 &&
                    layout.slots <= kMaxSlots && layout.total() == size;
  if (!sane) {
    munmap(base, size);
    throw Error(name, unreadable);
  }
  map_ = std::make_unique<Map>(name, file.st_ino, base, layout);
  for (int i = 0; i < layout.num_cameras; ++i)
    cameras_.emplace_back(h.names[i], strnlen(h.names[i], kNameSize));
}

FrameRingReader::~FrameRingReader() = default;

int FrameRingReader::FindCamera(const std::string& name) const {
  std::string known;
  for (size_t i = 0; i < cameras_.size(); ++i) {
    if (cameras_[i] == name) return static_cast<int>(i);
    known += (i ? ", " : "") + cameras_[i];
  }
  throw std::runtime_error("the frame ring has no camera \"" + name + "\"; known: " + known);
}

int FrameRingReader::width() const { return map_->layout.width; }
int FrameRingReader::height() const { return map_->layout.height; }
bool FrameRingReader::has_depth() const { return map_->layout.depth; }

int64_t FrameRingReader::newest_seq() const noexcept {
  int64_t newest = INT64_MAX;
  for (int i = 0; i < map_->layout.num_cameras; ++i) {
    newest = std::min(newest, map_->header().newest[i].load(std::memory_order_acquire));
  }
  return newest;
}

bool FrameRingReader::current() const noexcept {
  const Descriptor fd(shm_open(map_->name.c_str(), O_RDONLY, 0));
  struct stat file;
  return fd.fd >= 0 && fstat(fd.fd, &file) == 0 && file.st_ino == map_->inode;
}

FrameRead FrameRingReader::Read(int64_t frame_seq, int camera, Frame& out) const {
  if (camera < 0 || camera >= map_->layout.num_cameras || frame_seq < 1) return FrameRead::kAbsent;
  const size_t i = map_->Index(camera, frame_seq);
  const Slot& slot = map_->slot(i);
  const int64_t version = slot.version.load(std::memory_order_acquire);
  if (slot.frame_seq.load(std::memory_order_acquire) != frame_seq) return FrameRead::kAbsent;
  if (version % 2 != 0) return FrameRead::kTorn;
  out.frame_seq = frame_seq;
  out.exposure_us = slot.exposure_us.load(std::memory_order_acquire);
  if (!out.rgb.isContinuous()) out.rgb.release();
  out.rgb.create(map_->layout.height, map_->layout.width, CV_8UC3);
  LoadWords(map_->pixels(i), out.rgb.data, map_->layout.bytes());
  if (map_->layout.depth) {
    if (!out.depth.isContinuous()) out.depth.release();
    out.depth.create(map_->layout.height, map_->layout.width, CV_16UC1);
    LoadWords(map_->depths(i), out.depth.data, map_->layout.depth_bytes());
  } else {
    out.depth.release();
  }
  return slot.version.load(std::memory_order_relaxed) == version ? FrameRead::kWhole : FrameRead::kTorn;
}

}  // namespace intabs
