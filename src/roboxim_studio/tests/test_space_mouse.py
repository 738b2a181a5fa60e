"""A SpaceMouse: its recorded reports, and the way of its reports through the page.

No device is needed: reports of a SpaceNavigator, as recorded by others with Wireshark, and of a SpaceMouse Wireless as
pyspacemouse describes them, come from an object in the page that behaves like the browser's.
"""

import struct

import pytest
from browser import wait_for

from roboxim_core.poses import Pose
from roboxim_studio.acting.space_mouse import SpaceMouse
from roboxim_studio.acting.steering import Steering, action_of, moves

HERE = Pose(position=(0.5, 0.0, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))


def steering(**hid):
    return Steering.of_message({"held": [], "pad": None, "hid": {name[1:]: list(data) for name, data in hid.items()}})


def test_recorded_reports_of_a_space_navigator():
    assert steering(_1=bytes(6)).directions() == (0.0,) * 6
    (*moved, roll, pitch, yaw) = steering(_1=bytes(6), _2=bytes.fromhex("0000e2ff0000")).directions()
    assert (*moved, roll, pitch, yaw) == (0.0,) * 6, "30 of 350 is a hand that rests"
    full = steering(_1=struct.pack("<3h", 350, -350, -350)).directions()
    assert full[:3] == pytest.approx((1.0, -1.0, 1.0)), "right, away and up are -y, +x and +z of the base"
    assert steering(_2=struct.pack("<3h", 0, 0, 350)).directions()[5] == -1.0, "clockwise from above"
    assert SpaceMouse.of_reports({"3": [1, 0]}).buttons == {0}
    assert SpaceMouse.of_reports({"3": [3, 0]}).buttons == {0, 1}
    assert steering(_3=b"\x01\x00").once() == {"Space"}
    assert steering(_3=b"\x02\x00").once() == {"Enter"}


def test_newer_devices_report_both_at_once():
    both = steering(_1=struct.pack("<6h", 0, -350, 0, 0, 0, -350)).directions()
    assert both == pytest.approx((1.0, 0, 0, 0, 0, 1.0))
    action = action_of(steering(_1=struct.pack("<6h", 0, -350, 0, 0, 0, -350)), HERE, 1.0, 10.0)
    assert action == pytest.approx([0.02, 0, 0, 0, 0, 0.1, 1.0])


@pytest.mark.parametrize(
    "hid",
    [None, 3, [], {"1": "x"}, {"1": [1, 2]}, {"1": [256] * 6}, {"1": [True] * 6}, {"1": [0] * 9999}, {"3": [-1]}],
)
def test_nonsense_counts_as_rest(hid):
    said = Steering.of_message({"held": [], "hid": hid})
    assert not moves(action_of(said, HERE, 1.0, 10.0), 1.0)
    assert not said.once()


FAKE = """
class Device extends EventTarget {
  constructor() { super(); this.vendorId = 0x256f; this.productName = "SpaceMouse Compact"; this.opened = false; }
  async open() { this.opened = true; }
  report(id, ...bytes) {
    const event = new Event("inputreport");
    event.reportId = id;
    event.data = new DataView(new Uint8Array(bytes).buffer);
    this.dispatchEvent(event);
  }
}
window.hidAsked = [];
const hid = new EventTarget();
hid.getDevices = async () => [];
hid.requestDevice = async (options) => {
  window.hidAsked.push(options);
  window.hidDevice = new Device();
  return [window.hidDevice];
};
Object.defineProperty(navigator, "hid", { value: hid });
"""


@pytest.mark.thorough
def test_a_space_mouse_in_the_page_moves_the_tool(studio, chromium, tmp_path):
    studio.drive.bags = tmp_path
    studio.open_task("pick_cube").result(timeout=120)
    studio.show("Drive")
    script = chromium.before_pages(FAKE)
    try:
        chromium.open(studio.url)
        chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
        chromium.click("Connect a SpaceMouse")
        chromium.wait("document.querySelector('#studio-line').innerText.includes('SpaceMouse: SpaceMouse Compact')")
        assert chromium.run("window.hidAsked[0].filters.map((one) => one.vendorId)") == [0x256F, 0x046D]
        drive = studio.drive.begin().result(timeout=120)
        chromium.wait("document.documentElement.dataset.studioDriving === 'true'")
        start = drive.state
        chromium.run("window.hidDevice.report(1, 0, 0, 0, 0, 0xa2, 0xfe)")  # -350: up
        wait_for(lambda: drive.state.seq >= start.seq + 4, "four ticks", 60)
        chromium.run("window.hidDevice.report(1, 0, 0, 0, 0, 0, 0)")
        wait_for(lambda: not any(studio.drive.steering().directions()), "rest", 60)
        up = [after.robot.pose_tcp_commanded.position[2] for after in (start, drive.state)]
        assert up[1] - up[0] == pytest.approx(0.02 * (drive.state.seq - start.seq), abs=1e-4)
        chromium.run("window.hidDevice.report(3, 1, 0)")
        wait_for(lambda: drive.state.robot.gripper_command == 0.0, "the gripper", 60)
        chromium.run("window.hidDevice.report(3, 2, 0)")
        wait_for(lambda: drive.result is not None, "the end", 60)
        assert drive.bag is not None
    finally:
        chromium.forget(script)
