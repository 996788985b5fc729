// Typed publish and subscribe over LCM (lcm_bus.h) or within one process (memory_bus.h). Both carry the same
// bytes.
//
//   LcmBus bus("udpm://239.255.76.67:7667?ttl=0", /*prefix=*/"");
//   Newest<ArmStatus> status;
//   bus.Subscribe(kLite6Status, [&](const ArmStatus& s) { status.Offer(s); });
//   while (bus.Handle(100) >= 0) {
//     ArmStatus s;
//     if (status.Take(s)) bus.Publish(kLite6Command, Answer(s));
//   }
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <type_traits>
#include <utility>

#include "intabs/bus/codec.h"
#include "intabs/bus/messages.h"
#include "intabs/core/types.h"

namespace intabs {

// A channel's name and the struct that travels on it: the wrong struct does not compile.
template <class M>
struct Channel {
  std::string name;
};
inline const Channel<ArmStatus> kLite6Status{"LITE6_STATUS"};
inline const Channel<ArmCommand> kLite6Command{"LITE6_COMMAND"};
inline const Channel<ObjectPoses> kObjectPoses{"OBJECT_POSES"};
inline const Channel<PerceptionStatus> kPerceptionStatus{"PERCEPTION_STATUS"};
inline const Channel<SkillPlan> kSkillPlan{"SKILL_PLAN"};
inline const Channel<SkillStatus> kSkillStatus{"SKILL_STATUS"};
inline const Channel<SkillControl> kSkillControl{"SKILL_CONTROL"};
inline const Channel<LoopStatus> kLoopStatus{"LOOP_STATUS"};
inline const Channel<PlantTruth> kPlantTruth{"PLANT_TRUTH"};
inline const Channel<PlantControl> kPlantControl{"PLANT_CONTROL"};
inline const Channel<Estop> kEstop{"ESTOP"};
inline const Channel<Reset> kReset{"RESET"};
inline Channel<TagDetections> TagDetectionsChannel(const std::string& camera) {
  return {"TAG_DETECTIONS_" + camera};
}
inline Channel<HandKeypoints> HandKeypointsChannel(const std::string& camera) {
  return {"HAND_KEYPOINTS_" + camera};
}
inline Channel<TrackedHand> HandPointsChannel(const std::string& camera) { return {"HAND_POINTS_" + camera}; }

// One thread at a time. Not real-time safe as a whole: a publish is one system call, without allocation for
// the messages of the arm.
class Bus {
 public:
  // `prefix` comes before every channel's name (two arms on one network: "MASTER_"). Throws unless it is of
  // letters, digits and underscores.
  explicit Bus(std::string prefix);
  virtual ~Bus() = default;
  Bus(const Bus&) = delete;
  Bus& operator=(const Bus&) = delete;

  // False if the network refuses it.
  template <class M>
  bool Publish(const Channel<M>& channel, const M& message) {
    const int size = Encode(message, buffer_);
    return size > 0 && PublishBytes(channel.name, buffer_, size);
  }

  // `handler` runs inside Handle(), for every message, in the order of arrival. A datagram that is not a
  // whole message of this type changes nothing: it is counted, and `on_undecodable` runs if there is one.
  template <class M>
  void Subscribe(const Channel<M>& channel, std::type_identity_t<std::function<void(const M&)>> handler,
                 std::function<void()> on_undecodable = nullptr) {
    SubscribeBytes(channel.name,
                   [this, handler = std::move(handler), on_undecodable = std::move(on_undecodable),
                    message = M()](const uint8_t* data, size_t size) mutable {
                     if (Decode(data, size, message)) {
                       handler(message);
                     } else {
                       ++undecodable_;
                       if (on_undecodable) on_undecodable();
                     }
                   });
  }

  // Waits for a message, at most timeout_ms, then hands out all that have come. Returns how many, 0 also
  // after a signal, -1 when the bus is broken.
  virtual int Handle(int timeout_ms) = 0;

  // Undecodable datagrams so far, all subscriptions together.
  int64_t undecodable() const { return undecodable_; }

  // The layer below: `channel` without the prefix.
  virtual bool PublishBytes(const std::string& channel, const uint8_t* data, size_t size) = 0;
  using BytesHandler = std::function<void(const uint8_t* data, size_t size)>;
  virtual void SubscribeBytes(const std::string& channel, BytesHandler handler) = 0;

 protected:
  const std::string prefix_;

 private:
  int64_t undecodable_ = 0;
  uint8_t buffer_[kMaxMessageBytes];
};

// Of all messages of one Handle() keeps the one with the highest seq: LCM hands out a backlog oldest first.
// What was taken before does not count: a repeated seq, or that of a restarted sender, is offered again.
template <class M>
class Newest {
 public:
  void Offer(const M& m) {
    if (!waiting_ || m.seq >= newest_.seq) newest_ = m;
    waiting_ = true;
  }
  // False if nothing came since the last Take().
  bool Take(M& out) {
    if (!waiting_) return false;
    out = newest_;
    waiting_ = false;
    return true;
  }

 private:
  M newest_;
  bool waiting_ = false;
};

}  // namespace intabs
