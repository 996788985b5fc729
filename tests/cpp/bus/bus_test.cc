#include "intabs/bus/bus.h"

#include <catch2/catch.hpp>
#include <cstdio>
#include <memory>
#include <random>
#include <vector>

#include "bus/samples.h"
#include "intabs/bus/lcm_bus.h"
#include "intabs/bus/memory_bus.h"
#include "intabs_lcm/hand_keypoints_t.hpp"

namespace intabs {
namespace {

using samples::Largest;
using samples::Same;

// A private LCM network on this host, or null, with a line, where there is no multicast.
std::unique_ptr<LcmBus> OpenLcm() {
  std::random_device random;
  const int port = 20000 + static_cast<int>(random() % 20000);
  try {
    return std::make_unique<LcmBus>("udpm://239.255.76.67:" + std::to_string(port) + "?ttl=0", "TEST_");
  } catch (const std::runtime_error& e) {
    if (std::string(e.what()).find("no route") == std::string::npos) throw;
    std::printf("skipped: no multicast route: %s\n", e.what());
    return nullptr;
  }
}

// f(channel) for every channel there is.
template <class F>
void ForEachChannel(F f) {
  f(kLite6Status);
  f(kLite6Command);
  f(kObjectPoses);
  f(kPerceptionStatus);
  f(kSkillPlan);
  f(kSkillStatus);
  f(kSkillControl);
  f(kLoopStatus);
  f(kPlantTruth);
  f(kPlantControl);
  f(kEstop);
  f(kReset);
  f(TagDetectionsChannel("left"));
  f(HandKeypointsChannel("left"));
  f(HandPointsChannel("left"));
}

template <class M>
std::vector<uint8_t> Bytes(const M& m) {
  std::vector<uint8_t> bytes(kMaxMessageBytes);
  bytes.resize(Encode(m, bytes.data()));
  return bytes;
}

// Handles until `n` messages have come or nothing comes for a second.
int HandleAll(Bus& bus, int n) {
  int handled = 0;
  while (handled < n) {
    const int now = bus.Handle(1000);
    if (now <= 0) break;
    handled += now;
  }
  return handled;
}

void RoundTrip(Bus& bus) {
  ForEachChannel([&bus]<class M>(const Channel<M>& channel) {
    INFO(channel.name);
    const M sent = Largest<M>();
    int received = 0;
    bus.Subscribe(channel, [&](const M& m) { received += Same(m, sent); });
    REQUIRE(bus.Publish(channel, sent));
    HandleAll(bus, 1);
    CHECK(received == 1);
  });
  CHECK(bus.undecodable() == 0);
}

}  // namespace

TEST_CASE("Every message at its largest comes back the same, over LCM and in memory") {
  MemoryBus memory("TEST_");
  RoundTrip(memory);
  if (auto lcm = OpenLcm()) RoundTrip(*lcm);
}

TEST_CASE("Every message at its largest fits into 1400 bytes") {
  ForEachChannel([]<class M>(const Channel<M>& channel) {
    INFO(channel.name);
    const auto bytes = Bytes(Largest<M>());
    CHECK(bytes.size() > 8);
    CHECK(bytes.size() <= 1400);
  });
  CHECK(intabs_lcm::hand_keypoints_t().getEncodedSize() <= 1400);
}

TEST_CASE("Strings that are too long are cut, counts that are too high clamped") {
  PlantControl control;
  control.task = std::string(5000, 't');
  PlantControl control_back;
  auto bytes = Bytes(control);
  REQUIRE(Decode(bytes.data(), bytes.size(), control_back));
  CHECK(control_back.task == std::string(kMaxTaskName, 't'));

  SkillPlan plan;
  plan.n = 1000;
  SkillPlan plan_back;
  bytes = Bytes(plan);
  REQUIRE(Decode(bytes.data(), bytes.size(), plan_back));
  CHECK(plan_back.n == kMaxSkillsPerPart);
}

TEST_CASE("No datagram but a whole one of its type is decoded") {
  ForEachChannel([]<class M>(const Channel<M>& channel) {
    INFO(channel.name);
    M out;
    const auto good = Bytes(Largest<M>());
    REQUIRE(Decode(good.data(), good.size(), out));
    for (size_t n = 0; n < good.size(); ++n) {
      // A vector of just that size: reading on would be seen by the address sanitizer.
      const std::vector<uint8_t> cut(good.begin(), good.begin() + static_cast<long>(n));
      if (Decode(cut.data(), cut.size(), out)) FAIL("decoded when cut to " << n << " bytes");
    }
    auto longer = good;
    longer.push_back(0);
    CHECK_FALSE(Decode(longer.data(), longer.size(), out));
    ForEachChannel([&]<class Other>(const Channel<Other>& other) {
      if constexpr (!std::is_same_v<Other, M>) {
        const auto foreign = Bytes(Largest<Other>());
        INFO(other.name);
        CHECK_FALSE(Decode(foreign.data(), foreign.size(), out));
      }
    });
  });
}

TEST_CASE("Damaged datagrams never harm: lengths and counts of any value, and 100,000 random changes") {
  std::mt19937 random(7);
  ForEachChannel([&random]<class M>(const Channel<M>& channel) {
    INFO(channel.name);
    M out;
    const auto good = Bytes(Largest<M>());
    // Every place set to what hurts lengths and counts most.
    for (size_t at = 8; at + 4 <= good.size(); ++at) {
      for (const uint32_t evil : {0x00000000U, 0xffffffffU, 0x80000000U, 0x7fffffffU, 0x80808080U}) {
        auto bad = good;
        for (int i = 0; i < 4; ++i) bad[at + i] = static_cast<uint8_t>(evil >> (24 - 8 * i));
        (void)Decode(bad.data(), bad.size(), out);
      }
    }
    for (int k = 0; k < 10000; ++k) {
      auto bad = good;
      const int changes = 1 + static_cast<int>(random() % 8);
      for (int i = 0; i < changes; ++i) bad[random() % bad.size()] = static_cast<uint8_t>(random());
      (void)Decode(bad.data(), bad.size(), out);
    }
  });
}

TEST_CASE("Numbers that are not finite do not get in, but for commands, which the driver refuses by kind") {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  auto poses = Largest<ObjectPoses>();
  poses.objects[2].X_WO.p.y() = nan;
  auto bytes = Bytes(poses);
  CHECK_FALSE(Decode(bytes.data(), bytes.size(), poses));

  poses = Largest<ObjectPoses>();
  poses.objects[1].X_WO.q.coeffs() *= 1.01;  // no rotation
  bytes = Bytes(poses);
  CHECK_FALSE(Decode(bytes.data(), bytes.size(), poses));

  auto status = Largest<ArmStatus>();
  status.dq[5] = std::numeric_limits<double>::infinity();
  bytes = Bytes(status);
  CHECK_FALSE(Decode(bytes.data(), bytes.size(), status));

  auto command = Largest<ArmCommand>();
  command.q_target[0] = nan;
  bytes = Bytes(command);
  CHECK(Decode(bytes.data(), bytes.size(), command));
}

TEST_CASE("Garbage and truncated datagrams on every channel raise the counter and nothing else") {
  auto check = [](Bus& bus) {
    std::mt19937 random(3);
    int64_t sent = 0;
    ForEachChannel([&]<class M>(const Channel<M>& channel) {
      INFO(channel.name);
      int handled = 0;
      int undecodable = 0;
      bus.Subscribe(
          channel, [&](const M&) { ++handled; }, [&] { ++undecodable; });
      const auto good = Bytes(Largest<M>());
      for (int k = 0; k < 20; ++k) {
        std::vector<uint8_t> garbage(1 + random() % 1300);
        for (auto& b : garbage) b = static_cast<uint8_t>(random());
        REQUIRE(bus.PublishBytes(channel.name, garbage.data(), garbage.size()));
        REQUIRE(bus.PublishBytes(channel.name, good.data(), random() % good.size()));
      }
      sent += 40;
      HandleAll(bus, 40);
      CHECK(handled == 0);
      CHECK(undecodable == 40);
      CHECK(bus.undecodable() == sent);
      // And the channel still works.
      REQUIRE(bus.Publish(channel, Largest<M>()));
      HandleAll(bus, 1);
      CHECK(handled == 1);
    });
  };
  MemoryBus memory;
  check(memory);
  if (auto lcm = OpenLcm()) check(*lcm);
}

TEST_CASE("After a backlog the newest message by seq is taken, once") {
  auto check = [](Bus& bus) {
    Newest<ArmCommand> newest;
    bus.Subscribe(kLite6Command, [&](const ArmCommand& c) { newest.Offer(c); });
    ArmCommand c;
    for (int64_t seq = 1; seq <= 100; ++seq) {  // LCM's own default keeps the oldest 31
      c.seq = seq;
      bus.Publish(kLite6Command, c);
    }
    c.seq = 99;  // reordered
    bus.Publish(kLite6Command, c);
    REQUIRE(HandleAll(bus, 101) == 101);
    REQUIRE(newest.Take(c));
    CHECK(c.seq == 100);
    CHECK_FALSE(newest.Take(c));
    c.seq = 1;  // a restarted sender
    bus.Publish(kLite6Command, c);
    HandleAll(bus, 1);
    REQUIRE(newest.Take(c));
    CHECK(c.seq == 1);
  };
  MemoryBus memory;
  check(memory);
  if (auto lcm = OpenLcm()) check(*lcm);
}

TEST_CASE("A prefix separates two arms on one network") {
  std::random_device random;
  const std::string url = "udpm://239.255.76.67:" + std::to_string(20000 + random() % 20000) + "?ttl=0";
  if (!OpenLcm()) return;
  LcmBus master(url, "MASTER_");
  LcmBus puppet(url, "PUPPET_");
  int heard = 0;
  puppet.Subscribe(kLite6Status, [&](const ArmStatus&) { ++heard; });
  master.Publish(kLite6Status, ArmStatus{});
  puppet.Publish(kLite6Status, ArmStatus{});
  while (puppet.Handle(200) > 0) {
  }
  CHECK(heard == 1);
}

TEST_CASE("What cannot work is said in one line") {
  CHECK_THROWS_WITH(LcmBus("udpm://10.0.0.1:7667"),
                    Catch::Contains("10.0.0.1") && Catch::Contains("no multicast"));
  CHECK_THROWS_WITH(LcmBus("nonsense://"), Catch::Contains("nonsense"));
  CHECK_THROWS_WITH(MemoryBus("A.*"), Catch::Contains("A.*"));
}

}  // namespace intabs
