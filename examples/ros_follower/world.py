"""A ROS node that simulates a leader and the robot that follows it.

It publishes the robot's measurements and the clock. It waits for a command on ``cmd_vel`` before
each step, so that the run does not depend on the speed of the nodes.
"""

from __future__ import annotations

import math
import random

import rospy
from geometry_msgs.msg import PointStamped, Twist
from rosgraph_msgs.msg import Clock
from std_msgs.msg import UInt32

STEP = 0.1  # seconds


class World:
    """The leader and the robot, each with its place and heading."""

    def __init__(self) -> None:
        self.clock = rospy.Publisher("/clock", Clock, queue_size=10)
        self.sight = rospy.Publisher("leader", PointStamped, queue_size=10)
        rospy.Subscriber("reset", UInt32, self.reset)
        rospy.Subscriber("cmd_vel", Twist, self.step)

    def reset(self, seed: UInt32) -> None:
        """Begin an episode: the leader is two metres ahead."""
        self.chance, self.steps, self.turn = random.Random(seed.data), 0, 0.0
        self.leader, self.robot = [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        while not self.sight.get_num_connections():
            rospy.rostime.wallsleep(0.01)
        self.publish()

    def step(self, command: Twist) -> None:
        """Move both for a step."""
        self.turn += self.chance.gauss(-0.1 * self.turn, 0.2)
        for body, speed, turn in (
            (self.leader, 0.5, self.turn),
            (self.robot, command.linear.x, command.angular.z),
        ):
            body[2] += turn * STEP
            body[0] += speed * STEP * math.cos(body[2])
            body[1] += speed * STEP * math.sin(body[2])
        self.steps += 1
        self.publish()

    def publish(self) -> None:
        """Publish the time, and where the robot sees the leader: metres ahead and to the left."""
        east, north, heading = (
            self.leader[0] - self.robot[0],
            self.leader[1] - self.robot[1],
            self.robot[2],
        )
        sight = PointStamped()
        sight.header.stamp = rospy.Time.from_sec(self.steps * STEP)
        sight.point.x = east * math.cos(heading) + north * math.sin(heading)
        sight.point.y = north * math.cos(heading) - east * math.sin(heading)
        self.clock.publish(Clock(sight.header.stamp))
        self.sight.publish(sight)


if __name__ == "__main__":
    rospy.init_node("world")
    world = World()
    rospy.spin()
