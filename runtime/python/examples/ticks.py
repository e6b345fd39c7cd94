"""The same ticks as through Rust and C: actions to compare bit for bit, and what a tick takes.

    python ticks.py BUNDLE PICTURES OUT

PICTURES: bytes of all pictures, one after the other, for a bundle that reads one camera. OUT: all actions (f32, little
endian), then the time of each `observe` (ns, u64). Every action is executed as it was decided.
"""

import sys
import time
from pathlib import Path

import numpy as np

from rcwm import Policy

bundle, pictures, out = sys.argv[1:]
policy = Policy(bundle)
(camera,) = policy.interface.cameras
images = np.fromfile(pictures, np.uint8).reshape(-1, *camera.shape)
actions = np.empty((len(images), len(policy.low)), "<f4")
times_ns = np.empty(len(images), "<u8")
executed, computed_ns = None, np.empty(len(images))
for tick, image in enumerate(images):
    begun_ns = time.perf_counter_ns()
    decision = policy.observe({camera.name: image}, executed)
    times_ns[tick] = time.perf_counter_ns() - begun_ns
    actions[tick] = executed = decision.action
    computed_ns[tick] = sum(decision.stage_ns.values())
    policy.work_ahead(executed)
Path(out).write_bytes(actions.tobytes() + times_ns.tobytes())
for what, times in (("observe", times_ns), ("of it the parts", computed_ns), ("the rest", times_ns - computed_ns)):
    p50, p99 = np.percentile(times, [50, 99]) / 1e3
    print(f"{what:>16}: p50 {p50:8.1f} us, p99 {p99:8.1f} us")
