"""Finds hands with MediaPipe. Runs in an environment of its own (tools/setup --hands), knows nothing of intabs, and is
spoken to through pipes: frames in, key points out (estimator.py).

in:  int32 width, height, then height * width * 3 bytes RGB
out: 21 x (u, v) float32 px, integer = pixel centre, NaN without a hand; float32 score; float32 ms
"""

import os
import struct
import sys
import time


def main() -> None:
    static = sys.argv[1] == "independent"
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # MediaPipe prints

    import numpy as np
    from mediapipe.python.solutions.hands import Hands

    hands = Hands(static_image_mode=static, max_num_hands=1)
    frames = sys.stdin.buffer
    answers.write(b"ready\n")
    answers.flush()
    while header := frames.read(8):
        width, height = struct.unpack("<ii", header)
        rgb = np.frombuffer(frames.read(width * height * 3), np.uint8).reshape(height, width, 3)
        start = time.perf_counter()
        found = hands.process(rgb)
        ms = 1e3 * (time.perf_counter() - start)
        uv, score = np.full((21, 2), np.nan, "f4"), 0.0
        if found.multi_hand_landmarks:
            points = found.multi_hand_landmarks[0].landmark
            # MediaPipe counts from the picture's edge.
            uv[:] = [(p.x * width - 0.5, p.y * height - 0.5) for p in points]
            score = found.multi_handedness[0].classification[0].score
        answers.write(uv.astype("<f4").tobytes() + struct.pack("<ff", score, ms))
        answers.flush()


if __name__ == "__main__":
    main()
