"""The vendor's own client against our fake controller: what it does to a real arm works, and the bytes are its own."""

import json
import subprocess
import sys
import textwrap

import pytest
from lite6_bench import Fake, need_lite6

from intabs.processes import Processes

need_lite6()
pytest.importorskip("xarm", reason="skipped: xarm-python-sdk is not installed (pip install '.[train]')")

# The ports are constants of the module, changed before the client is made; its reports' layout goes by the usual port.
PREAMBLE = """
import json, sys, time
from xarm.core.config.x_config import XCONF
control, reports = {port}, {reports}
ports = XCONF.SocketConf
ports.TCP_CONTROL_PORT = control
ports.TCP_REPORT_NORM_PORT, ports.TCP_REPORT_RICH_PORT = reports + 1, reports + 2
ports.TCP_REPORT_REAL_PORT = reports + 3
import xarm.x3.base
create = xarm.x3.base.ReportDataStructure.create
xarm.x3.base.ReportDataStructure.create = classmethod(lambda cls, port, **kw: create(30000 + port - reports, **kw))
from xarm.wrapper import XArmAPI
arm = XArmAPI("127.0.0.1", is_radian=True, report_type={kind!r})
def say(**what):
    print("RESULT " + json.dumps(what))
"""


def vendor(fake: Fake, script: str, kind: str = "rich") -> dict:
    """Runs the vendor's client in a process of its own: it changes module constants and leaves threads behind."""
    code = PREAMBLE.format(port=fake.port, reports=fake.reports, kind=kind) + textwrap.dedent(script)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    lines = [s for s in done.stdout.splitlines() if s.startswith("RESULT ")]
    assert len(lines) == 1, done.stdout + done.stderr
    return json.loads(lines[0].removeprefix("RESULT "))


@pytest.fixture
def fake(tmp_path):
    with Processes(tmp_path) as processes:
        yield Fake(processes)


ENABLE = """
arm.clean_error(); arm.clean_warn()
assert arm.motion_enable(True) == 0
assert arm.set_mode(1) == 0
assert arm.set_state(0) == 0
time.sleep(0.3)
"""


@pytest.mark.parametrize("kind", ["rich", "normal", "real"])
def test_it_connects_enables_streams_500_targets_at_250_hz_and_reads_states(fake, kind):
    result = vendor(
        fake,
        ENABLE
        + """
code, q = arm.get_servo_angle(is_radian=True)
q = q[:6]
begin, codes = time.monotonic(), []
for i in range(500):
    codes.append(arm.set_servo_angle_j([q[0] + 0.0005 * i] + q[1:], is_radian=True))
    time.sleep(max(0, begin + 0.004 * (i + 1) - time.monotonic()))
rate = 500 / (time.monotonic() - begin)
time.sleep(0.4)
code, states = arm.get_joint_states(is_radian=True)
say(codes=sorted(set(codes)), rate=rate, code=code, q0=q[0], reached=states[0][0], state=arm.state, mode=arm.mode,
    version=arm.version, axis=arm.axis, type=arm.device_type, error=arm.error_code)
""",
        kind,
    )
    assert result["codes"] == [0]
    assert result["rate"] == pytest.approx(250, rel=0.2)
    assert result["code"] == 0
    assert result["reached"] == pytest.approx(result["q0"] + 0.0005 * 499, abs=1e-5)
    assert (result["mode"], result["axis"], result["type"], result["error"]) == (1, 6, 9, 0)
    state = fake.state
    assert state["servo_requests"] == 500
    assert state["servo_rejected"] == 0
    assert state["max_joint_speed"] < 3.14


def test_it_is_told_what_is_wrong(fake):
    result = vendor(
        fake,
        """
arm.clean_error()
arm.motion_enable(False)
q = arm.get_servo_angle(is_radian=True)[1][:6]
disabled = arm.set_servo_angle_j(q, is_radian=True)
"""
        + ENABLE
        + """
arm.set_mode(0); arm.set_state(0); time.sleep(0.3)
wrong_mode = arm._arm.arm_cmd.move_servoj(q + [0], 0, 0, 0)[0]
arm.set_mode(1); arm.set_state(0); time.sleep(0.3)
fast = arm.set_servo_angle_j([q[0] + 0.5] + q[1:], is_radian=True)
time.sleep(0.3)
error = arm.get_err_warn_code()[1]
after = arm._arm.arm_cmd.move_servoj(q + [0], 0, 0, 0)[0]
arm.clean_error(); arm.motion_enable(True); arm.set_mode(1); arm.set_state(0); time.sleep(0.3)
arm.emergency_stop()
say(disabled=disabled, wrong_mode=wrong_mode, fast=fast, error=error, after=after, state=arm.get_state()[1])
""",
    )
    assert result["disabled"] != 0
    assert result["wrong_mode"] == 10
    assert result["error"][0] in (24, 60)
    assert result["after"] == 1
    assert result["state"] == 4


def test_gripper_velocity_mode_and_settings(fake):
    result = vendor(
        fake,
        ENABLE
        + """
codes = [arm.open_lite6_gripper(sync=False), arm.close_lite6_gripper(sync=False)]
outputs = arm.get_tgpio_output_digital()[1]
codes += [arm.set_mode(4), arm.set_state(0)]
time.sleep(0.3)
q = arm.get_servo_angle(is_radian=True)[1][0]
codes.append(arm.vc_set_joint_velocity([0.1, 0, 0, 0, 0, 0], is_radian=True, duration=0.2))
time.sleep(0.6)
moved = arm.get_servo_angle(is_radian=True)[1][0] - q
codes += [arm.set_collision_sensitivity(3), arm.set_state(0), arm.set_tcp_load(0.3, [0, 0, 30]), arm.set_state(0)]
codes += [arm.set_mode(2), arm.set_state(0)]
time.sleep(0.3)
say(codes=codes, outputs=outputs[:2], moved=moved, mode=arm.mode)
""",
    )
    assert result["codes"] == [0] * len(result["codes"])
    assert result["outputs"] == [0, 1]
    assert result["moved"] == pytest.approx(0.02, abs=0.002)
    assert result["mode"] == 2
    assert fake.state["gripper"] == "closed"
