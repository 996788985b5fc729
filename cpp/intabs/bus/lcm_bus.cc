#include "intabs/bus/lcm_bus.h"

#include <arpa/inet.h>
#include <lcm/lcm.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <stdexcept>

namespace intabs {
namespace {

constexpr char kCure[] = "ip link set lo up; ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo";

// LCM itself answers a missing route with a page of text on stderr, so the route is tried before.
void RequireRoute(const std::string& url) {
  constexpr char kScheme[] = "udpm://";
  if (url.rfind(kScheme, 0) != 0) {
    throw std::runtime_error("LCM URL \"" + url + "\" is not of UDP multicast; give one like " +
                             kDefaultLcmUrl);
  }
  const size_t begin = std::strlen(kScheme);
  std::string host = url.substr(begin, url.find_first_of(":?", begin) - begin);
  if (host.empty()) host = "239.255.76.67";
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(7667);
  if (inet_pton(AF_INET, host.c_str(), &address.sin_addr) != 1 ||
      !IN_MULTICAST(ntohl(address.sin_addr.s_addr))) {
    throw std::runtime_error("LCM URL \"" + url + "\": \"" + host +
                             "\" is no multicast address; give one like " + kDefaultLcmUrl);
  }
  const int fd = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  if (fd < 0) throw std::runtime_error(std::string("no UDP socket: ") + std::strerror(errno));
  const int rc = connect(fd, reinterpret_cast<sockaddr*>(&address), sizeof(address));
  const int error = errno;
  close(fd);
  if (rc != 0) {
    throw std::runtime_error("LCM at " + url + ": " + std::strerror(error) +
                             "; there is no route for multicast, as root run: " + kCure);
  }
}

void Dispatch(const lcm_recv_buf_t* received, const char*, void* handler) {
  (*static_cast<Bus::BytesHandler*>(handler))(static_cast<const uint8_t*>(received->data),
                                              received->data_size);
}

void DispatchAny(const lcm_recv_buf_t* received, const char* channel, void* handler) {
  (*static_cast<LcmBus::AnyHandler*>(handler))(
      received->recv_utime, channel, static_cast<const uint8_t*>(received->data), received->data_size);
}

}  // namespace

LcmBus::LcmBus(const std::string& url, std::string prefix) : Bus(std::move(prefix)) {
  RequireRoute(url);
  lcm_ = lcm_create(url.c_str());
  if (lcm_ == nullptr) {
    throw std::runtime_error("LCM refuses the URL \"" + url + "\"; give one like " + kDefaultLcmUrl);
  }
}

LcmBus::~LcmBus() { lcm_destroy(lcm_); }

int LcmBus::Handle(int timeout_ms) {
  int handled = 0;
  pollfd fd{lcm_get_fileno(lcm_), POLLIN, 0};
  while (handled < kMaxBatch) {
    const int ready = poll(&fd, 1, handled == 0 ? timeout_ms : 0);
    if (ready < 0) return errno == EINTR ? handled : -1;
    if (ready == 0) break;
    if (lcm_handle(lcm_) != 0) return -1;
    ++handled;
  }
  return handled;
}

bool LcmBus::PublishBytes(const std::string& channel, const uint8_t* data, size_t size) {
  channel_.assign(prefix_).append(channel);
  return lcm_publish(lcm_, channel_.c_str(), data, static_cast<unsigned>(size)) == 0;
}

void LcmBus::SubscribeBytes(const std::string& channel, BytesHandler handler) {
  handlers_.push_back(std::make_unique<BytesHandler>(std::move(handler)));
  lcm_subscription_t* s = lcm_subscribe(lcm_, (prefix_ + channel).c_str(), &Dispatch, handlers_.back().get());
  if (s == nullptr) throw std::runtime_error("LCM does not subscribe to " + prefix_ + channel);
  // A full queue drops what comes in, not what is old: let it hold whatever one Handle() hands out.
  lcm_subscription_set_queue_capacity(s, kMaxBatch);
}

void LcmBus::SubscribeAll(AnyHandler handler) {
  any_handlers_.push_back(std::make_unique<AnyHandler>(std::move(handler)));
  lcm_subscription_t* s = lcm_subscribe(lcm_, ".*", &DispatchAny, any_handlers_.back().get());
  if (s == nullptr) throw std::runtime_error("LCM does not subscribe to all channels");
  lcm_subscription_set_queue_capacity(s, 10 * kMaxBatch);
}

}  // namespace intabs
