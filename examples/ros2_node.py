r"""ROS 2 node that maps the images of a depth camera and publishes the objects as markers.

    python examples/ros2_node.py --ros-args -r color:=/camera/color/image_raw \
        -r depth:=/camera/aligned_depth_to_color/image_raw -r camera_info:=/camera/color/camera_info

Depth must be registered to color. Images of topics named `image_rect` or similar are rectified. All other images are
undistorted with the lens model of the camera info. Set `--compressed` before `--ros-args` for topics of
sensor_msgs/CompressedImage, such as `image_raw/compressed`. Publishers may be reliable or best effort. Each marker on
the topic `objects` is the axis-aligned bounding box of one object in the world frame, `map`. The text of a marker is
the class name.
"""

from __future__ import annotations

import sys

import message_filters
import numpy as np
import rclpy
from geometry_msgs.msg import Point, Vector3
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import Marker, MarkerArray

from instancemap import DataError, Mapper, decode_ros_color, decode_ros_depth, is_rectified, ros_camera


class InstanceMapNode(Node):
    """Node that maps synchronized color and depth images.

    `overrides` are config overrides such as "device=cuda". Set `compressed` for topics of sensor_msgs/CompressedImage.
    """

    rectified = False  # True = the images belong to the matrix P of the camera info, without distortion

    def __init__(self, *overrides: str, compressed: bool = False) -> None:
        from rclpy.qos import qos_profile_sensor_data  # best effort, which also receives from reliable publishers

        super().__init__("instancemap")
        self.mapper = Mapper(*overrides)
        self.markers = self.create_publisher(MarkerArray, "objects", 1)
        image = image_type(compressed)
        topics = (("color", image), ("depth", image), ("camera_info", CameraInfo))
        subscribers = [
            message_filters.Subscriber(self, kind, name, qos_profile=qos_profile_sensor_data) for name, kind in topics
        ]
        synchronizer = message_filters.ApproximateTimeSynchronizer(subscribers, queue_size=2, slop=0.02)
        synchronizer.registerCallback(self.map)  # while a frame is mapped, the queue keeps the two newest frames

    def map(self, color: Image, depth: Image, info: CameraInfo) -> None:
        stamp = color.header.stamp.sec + 1e-9 * color.header.stamp.nanosec
        try:
            camera, lens = ros_camera("camera_info", info, self.rectified)
            image, metric = rgb(color), meters(depth)
            if lens is not None:
                image, metric = lens.smooth(image), lens.exact(metric)
            result = self.mapper.add(image, metric, camera=camera, timestamp=stamp)
        except DataError as error:  # for example an unsupported encoding
            self.get_logger().warning(str(error))
            return
        if result.lost:
            self.get_logger().warning(f"pose lost: {result.reason}", throttle_duration_sec=1.0)
        elif result.new or result.removed:
            self.markers.publish(MarkerArray(markers=[Marker(action=Marker.DELETEALL), *self.boxes()]))

    def boxes(self) -> list[Marker]:
        found = []
        for instance in self.mapper.instances().values():
            box = Marker(type=Marker.CUBE, id=instance.id, text=self.mapper.name(instance))
            box.header.frame_id = "map"
            box.pose.position = Point(**dict(zip("xyz", map(float, instance.aabb.center), strict=True)))
            box.scale = Vector3(**dict(zip("xyz", map(float, instance.aabb.extent), strict=True)))
            box.color.g, box.color.a = 1.0, 0.5
            found.append(box)
        return found


def image_type(compressed: bool) -> type:
    """Return the message type of the image topics."""
    if not compressed:
        return Image
    from sensor_msgs.msg import CompressedImage

    return CompressedImage


def rgb(image: Image) -> np.ndarray:
    """Convert an image message in any common encoding to an RGB image (H, W, 3), uint8."""
    return decode_ros_color("color", image)


def meters(image: Image) -> np.ndarray:
    """Convert an image message to depth (H, W), float32, m; 0 = no reading."""
    return decode_ros_depth("depth", image)


def main() -> None:
    """Run the node."""
    rclpy.init()
    node = InstanceMapNode("fuser.voxel_size=0.02", compressed="--compressed" in sys.argv)
    node.rectified = is_rectified(node.resolve_topic_name("color"))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
