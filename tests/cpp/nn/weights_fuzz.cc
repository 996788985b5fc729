// libFuzzer target for the weights loader; see weights_fuzz.h.
#include "nn/weights_fuzz.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  intabs::LoadFromBytes(data, size);
  return 0;
}
