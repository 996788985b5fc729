"""Frames of a camera -> HAND_KEYPOINTS_<camera>. Any other estimator may publish the same message
(proto_lcm/hand_keypoints_t.lcm)."""

from __future__ import annotations

import sys
import time

import numpy as np

from intabs import _core, bus
from intabs.hand.estimator import MediaPipeHands
from intabs.messages import hand_keypoints_t


def publish(spec: str, camera: str, url: str, independent: bool, most: int) -> dict:
    """Until the source ends, `most` frames (0: no limit) or Ctrl-C. RuntimeError, one line: there is no such source."""
    bus.require_route()
    source = _core.FrameSource(spec, camera, 0, 0, lambda text: print(text, file=sys.stderr, flush=True))
    link = bus.Bus(url)
    frames, sent, ms = 0, 0, []
    said = time.monotonic()
    with MediaPipeHands(independent) as hands:
        try:
            while not most or frames < most:
                what, seq, exposure_us, rgb = source.next()
                if what == "end":
                    break
                if what != "frame" or rgb is None:
                    continue
                frames += 1
                if hand := hands.find(rgb):
                    message = hand_keypoints_t()
                    message.utime = time.monotonic_ns() // 1000
                    message.exposure_utime, message.frame_seq, message.seq = exposure_us, seq, sent + 1
                    message.uv, message.score = hand.uv.tolist(), hand.score
                    link.publish(f"HAND_KEYPOINTS_{camera}", message)
                    sent += 1
                    ms.append(hand.ms)
                if time.monotonic() - said > 5:
                    said = time.monotonic()
                    print(f"hand: {frames} frames, a hand in {sent}", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            pass
    return {"frames": frames, "found": sent, "ms": {"p50": float(np.median(ms)) if ms else 0.0}}
