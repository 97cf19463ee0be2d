"""At the base: publishes each datum in ROS 2, and where each drone has measured. Needs a sourced ROS 2.

rass-mav ls base.yaml --follow --json | python3 ros2_bridge.py
"""

import json
import sys

import rclpy
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import Float64, String

rclpy.init()
node = rclpy.create_node("rass_mav")
data = node.create_publisher(String, "rass/data", 100)
readings, places = {}, {}
for line in sys.stdin:
    datum = json.loads(line)
    data.publish(String(data=line.strip()))
    measured = datum.get("measurement") or {"reading": None, "latitude": None}
    drone = f"rass/drone_{datum['id'].split('-')[0]}"
    if measured["reading"] is not None and measured["unit"] == "usvh":
        topic = readings.get(drone) or readings.setdefault(drone, node.create_publisher(Float64, f"{drone}/usvh", 10))
        topic.publish(Float64(data=measured["reading"]))
    if measured["latitude"] is not None:
        topic = places.get(drone) or places.setdefault(drone, node.create_publisher(NavSatFix, f"{drone}/fix", 10))
        topic.publish(NavSatFix(**{key: measured[key] for key in ("latitude", "longitude", "altitude")}))
