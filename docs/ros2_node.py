"""An example: a ROS 2 node between topics and `closedloop serve SCENARIO --port 40000` in real time.

It publishes joint_states (sensor_msgs/JointState) and wrench (geometry_msgs/WrenchStamped), and sends the torques that
come on effort_commands (std_msgs/Float64MultiArray). Only its syntax is tested.
"""

import json
import socket

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray


class Bridge(Node):
    """The node; its parameters are address and port."""

    def __init__(self):
        super().__init__("closedloop")
        address = self.declare_parameter("address", "127.0.0.1").value
        port = self.declare_parameter("port", 40000).value
        self.arm = socket.create_connection((address, port)).makefile("rwb")
        described = self.ask("describe")
        self.joints, self.torque = described["joints"], self.ask("state")["torque"]
        self.states = self.create_publisher(JointState, "joint_states", 1)
        self.wrenches = self.create_publisher(WrenchStamped, "wrench", 1)
        self.create_subscription(Float64MultiArray, "effort_commands", self.take, 1)
        self.create_timer(described["period"], self.cycle)

    def ask(self, do, **more):
        """Return the answer to a message."""
        self.arm.write(json.dumps({"do": do, **more}).encode() + b"\n")
        self.arm.flush()
        return json.loads(self.arm.readline())

    def take(self, message):
        """Keep the newest torques."""
        self.torque = list(message.data)

    def cycle(self):
        """Send the torques, and publish the state."""
        state = self.ask("torque", torque=self.torque)
        if "error" in state:
            self.get_logger().error(state["error"])
            return
        now = self.get_clock().now().to_msg()
        joints = JointState(name=self.joints, position=state["q"], velocity=state["v"], effort=state["torque"])
        joints.header.stamp = now
        self.states.publish(joints)
        wrench = WrenchStamped()
        wrench.header.stamp, wrench.header.frame_id = now, "base"
        force, moment = wrench.wrench.force, wrench.wrench.torque
        force.x, force.y, force.z, moment.x, moment.y, moment.z = self.ask("wrench")["wrench"]
        self.wrenches.publish(wrench)


def main():
    """Run the node until it is stopped."""
    rclpy.init()
    rclpy.spin(Bridge())


if __name__ == "__main__":
    main()
