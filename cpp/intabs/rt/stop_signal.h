// SIGINT and SIGTERM as a flag that loops look at.
#pragma once

namespace intabs {

// From now on the two signals end the process only by way of the flag. System calls they interrupt return
// EINTR.
void InstallStopSignals() noexcept;

// Real-time safe.
bool StopRequested() noexcept;

}  // namespace intabs
