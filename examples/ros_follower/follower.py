"""A ROS node that controls a robot which follows a leader. Its control callback is the decision.

``python3 follower.py [SEED]`` starts a ROS master on a free port and the simulated world, follows
the leader for 20 simulated seconds, and prints the result. rospy belongs to the system's Python,
and needs the client for other Pythons.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import queue
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parents[1] / "clients" / "python"))

import rosgraph  # noqa: E402
import rospy  # noqa: E402
from geometry_msgs.msg import PointStamped, Twist  # noqa: E402
from simenv_marl_client import Client, Episode  # noqa: E402
from std_msgs.msg import UInt32  # noqa: E402

PATIENCE = 20.0  # seconds that a message or a node may take

POINT = "follower.velocity"
client = Client([POINT])


class Follower:
    """The controller of the robot."""

    def __init__(self) -> None:
        # rospy calls back in threads of its own. They hand the messages over to the main thread,
        # which makes decisions.
        self.sights: queue.Queue[PointStamped] = queue.Queue()
        rospy.Subscriber("leader", PointStamped, self.sights.put)
        self.commands = rospy.Publisher("cmd_vel", Twist, queue_size=10)
        self.resets = rospy.Publisher("reset", UInt32, queue_size=10)
        for publisher in (self.commands, self.resets):
            wait_for("the world", publisher.get_num_connections)

    def follow(self, episode: Episode) -> None:
        """Follow the leader for an episode."""
        seconds = episode.options.get("seconds", 20.0)
        digest = hashlib.sha256()
        self.resets.publish(UInt32(episode.seed))
        while True:
            sight = self.sights.get(timeout=PATIENCE)
            now = sight.header.stamp.to_sec()
            digest.update(repr((now, sight.point.x, sight.point.y)).encode())
            if now >= seconds:
                break
            self.commands.publish(self.control(sight))
        client.update(POINT, ahead=sight.point.x, left=sight.point.y, time=now)
        result = {
            "digest": digest.hexdigest(),
            "distance": math.hypot(sight.point.x, sight.point.y),
        }
        client.end(result, truncated=True)
        if not client.connected:
            print(json.dumps(result))

    def control(self, sight: PointStamped) -> Twist:
        """Choose the velocity: the decision."""
        ahead, left, now = sight.point.x, sight.point.y, sight.header.stamp.to_sec()
        velocity = client.decide(
            POINT, rule=lambda: rule(ahead, left), time=now, ahead=ahead, left=left
        )
        command = Twist()
        command.linear.x, command.angular.z = velocity
        return command


def rule(ahead: float, left: float) -> list[float]:
    """Turn to the leader, and keep one metre behind it."""
    return [min(max(ahead - 1.0, 0.0), 1.0), min(max(math.atan2(left, ahead), -1.0), 1.0)]


def wait_for(what: str, condition: Callable[[], object]) -> None:
    """Wait until a condition holds."""
    limit = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > limit:
            raise TimeoutError(f"{what} has not been there for {PATIENCE} s")
        time.sleep(0.01)


def main() -> None:
    """Start the master, the world and this node, and end them with this process."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    os.environ.update(ROS_MASTER_URI=f"http://127.0.0.1:{port}", ROS_IP="127.0.0.1")
    # The master alone: children of roscore leave the process group, and would outlive a simulator
    # that is killed.
    started = [
        subprocess.Popen(["rosmaster", "--core", "-p", str(port)], stdout=subprocess.DEVNULL)
    ]
    try:
        wait_for("the ROS master", rosgraph.is_master_online)
        rospy.set_param("/use_sim_time", True)
        started.append(subprocess.Popen([sys.executable, str(HERE / "world.py")]))
        rospy.init_node("follower", disable_signals=True)
        client.run(Follower().follow, int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    finally:
        rospy.signal_shutdown("the end")
        for process in started:
            process.terminate()
            process.wait()


if __name__ == "__main__":
    main()
