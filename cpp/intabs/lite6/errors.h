// The controller's errors and warnings: what each is called, what usually causes it, what to do. Names follow the
// vendor's client; causes and cures its manual and the threads where users met them.
#pragma once

#include <string>

namespace intabs::lite6 {

struct VendorCode {
  int code;
  const char* name;
  const char* cause;
  const char* cure;
};

// Never fails: an unknown code has an entry of its own that says so.
const VendorCode& DescribeError(int code) noexcept;
const VendorCode& DescribeWarning(int code) noexcept;

// One line: "C24 speed exceeds limit: <cause>; <cure>". Allocates.
std::string ErrorLine(int code);
std::string WarningLine(int code);

}  // namespace intabs::lite6
