// libFuzzer target: whatever comes out of a report port, in one piece or cut anywhere.
#include <cstdlib>

#include "intabs/lite6/report.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace intabs;
  using namespace intabs::lite6;
  while (size > 0) {
    ArmReport report;
    size_t used = 0;
    const Parsed parsed = ParseReport(data, size, report, used);
    if (parsed != Parsed::kFrame) break;
    if (used == 0 || used > size) std::abort();
    if (!report.q.allFinite() || !report.dq.allFinite() || !report.tau.allFinite()) std::abort();
    // What was accepted survives the way back, but for what a report of its kind does not carry.
    uint8_t again[kMaxReportBytes];
    ArmReport twin;
    size_t twin_used = 0;
    const int bytes = EncodeReport(report, 0, report.q, again);
    if (ParseReport(again, static_cast<size_t>(bytes), twin, twin_used) != Parsed::kFrame) std::abort();
    if (twin.q != report.q || twin.mode != report.mode || twin.state != report.state) std::abort();
    data += used;
    size -= used;
  }
  return 0;
}
