// The driver of a real (or fake) Lite 6: client of the controller, command filter and safety states, joined into one tick.
// No LCM here: the program hands messages in and statuses out.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <string>

#include "intabs/control/arm_controller.h"
#include "intabs/control/tick_record.h"
#include "intabs/core/types.h"
#include "intabs/lite6/client.h"

namespace intabs::lite6 {

struct DriverOptions {
  ClientOptions client;  // mode kTeach: the arm is guided by hand, commands set the gripper alone
  ArmLimits limits;
  ArmModel model = ArmModel::Lite6();
  ArmSafety safety{.stall_us = 40'000};
};

class Driver {
 public:
  // Starts the client's thread.
  Driver(const DriverOptions& options, Client::Log log, std::function<void()> on_client_thread = nullptr);

  // From one other thread, for the next tick. A flood is dropped and counted, the oldest 64 of a tick are heard.
  void Offer(const ArmCommand& command) noexcept;
  // From any thread.
  void CountUndecodable() noexcept { undecodable_.fetch_add(1, std::memory_order_relaxed); }
  void Estop() noexcept { estop_.store(true, std::memory_order_release); }
  void Reset(int64_t session) noexcept { reset_.store(session, std::memory_order_release); }
  void ToggleGripper() noexcept { toggle_gripper_.store(true, std::memory_order_release); }  // while guided

  // Once per driver period, on the loop's thread; real-time safe.
  void Tick(int64_t now_us) noexcept;

  // After a tick, on its thread. Until the arm's pose is known there is nothing to say.
  bool has_status() const noexcept { return born_; }
  // All but source, overruns and tick_us.
  void FillStatus(ArmStatus& status) const noexcept;
  // All but wakeup_us and tick_us.
  void FillRecord(TickRecord& record) const noexcept;

  // Figures, on the loop's thread.
  const ClientState& client() const noexcept { return state_; }
  int64_t dropped_commands() const noexcept { return dropped_.load(std::memory_order_relaxed); }
  bool link_ok() const noexcept { return link_ok_; }

 private:
  void FollowPhase() noexcept;
  void HandleReset() noexcept;
  void HandleCommands(int64_t now_us) noexcept;
  void GuideByHand(int64_t now_us) noexcept;
  bool LinkOk(int64_t now_us) const noexcept;
  void Order() noexcept;
  bool Teaches() const noexcept { return mode_ == VendorMode::kTeach; }

  // From the bus thread to the tick, oldest first.
  static constexpr size_t kQueue = 64;
  std::array<ArmCommand, kQueue> queue_;
  std::atomic<uint64_t> written_{0}, read_{0};
  std::atomic<int64_t> undecodable_{0}, dropped_{0}, reset_{0};
  std::atomic<bool> estop_{false}, toggle_gripper_{false};

  const VendorMode mode_;
  ArmController controller_;
  ClientState state_;
  bool born_ = false;        // the arm's pose is known
  bool was_ready_ = false;   // since the connection or preparation before
  bool link_ok_ = false;
  uint32_t epoch_ = 0;       // of the preparation that the controller's reference goes on from
  uint32_t prepare_ = 1;     // the first one needs no RESET
  int64_t pending_reset_ = 0;
  int64_t counted_undecodable_ = 0;
  bool gripper_valid_ = false, guided_gripper_closed_ = false;
  double gripper_opening_;
  int64_t seq_ = 0, now_us_ = 0;
  int64_t guided_session_ = 0, guided_seq_ = 0;

  Client client_;  // last: its thread ends before the rest goes
};

}  // namespace intabs::lite6
