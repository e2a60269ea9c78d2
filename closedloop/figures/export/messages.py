"""The definitions of the standard ROS 2 messages that a run is written as."""

from __future__ import annotations

_TIME = """================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec"""
_HEADER = f"""================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_TIME}"""
_SEPARATOR = "=" * 80

_POINT = f"""{_SEPARATOR}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z"""
_POSE = f"""{_SEPARATOR}
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{_POINT}
{_SEPARATOR}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w"""

DEFINITIONS: dict[str, str] = {
    "sensor_msgs/msg/JointState": f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
    "geometry_msgs/msg/PoseStamped": f"""std_msgs/Header header
geometry_msgs/Pose pose
{_HEADER}
{_POSE}""",
    "geometry_msgs/msg/PointStamped": f"""std_msgs/Header header
geometry_msgs/Point point
{_HEADER}
{_POINT}""",
    "nav_msgs/msg/Path": f"""std_msgs/Header header
geometry_msgs/PoseStamped[] poses
{_HEADER}
{_SEPARATOR}
MSG: geometry_msgs/PoseStamped
std_msgs/Header header
geometry_msgs/Pose pose
{_POSE}""",
    "geometry_msgs/msg/WrenchStamped": f"""std_msgs/Header header
geometry_msgs/Wrench wrench
{_HEADER}
{_SEPARATOR}
MSG: geometry_msgs/Wrench
geometry_msgs/Vector3 force
geometry_msgs/Vector3 torque
{_SEPARATOR}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z""",
    "rcl_interfaces/msg/Log": f"""builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
{_TIME}""",
    "std_msgs/msg/String": "string data",
}
