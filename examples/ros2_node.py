r"""ROS 2 node that maps the images of a depth camera and publishes the objects as markers.

    python examples/ros2_node.py --ros-args -r color:=/camera/color/image_raw \
        -r depth:=/camera/aligned_depth_to_color/image_raw -r camera_info:=/camera/color/camera_info

Depth must be registered to color. Each marker on the topic `objects` is the axis-aligned bounding box of one object in
the world frame, `map`. The text of a marker is the class name.
"""

from __future__ import annotations

import message_filters
import numpy as np
import rclpy
from geometry_msgs.msg import Point, Vector3
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import Marker, MarkerArray

from instancemap import Camera, FrameError, Mapper


class InstanceMapNode(Node):
    """Node that maps synchronized color and depth images. `overrides` are config overrides such as "device=cuda"."""

    def __init__(self, *overrides: str) -> None:
        super().__init__("instancemap")
        self.mapper = Mapper(*overrides)
        self.markers = self.create_publisher(MarkerArray, "objects", 1)
        topics = (("color", Image), ("depth", Image), ("camera_info", CameraInfo))
        subscribers = [message_filters.Subscriber(self, kind, name) for name, kind in topics]
        synchronizer = message_filters.ApproximateTimeSynchronizer(subscribers, queue_size=2, slop=0.02)
        synchronizer.registerCallback(self.map)  # while a frame is mapped, the queue keeps the two newest frames

    def map(self, color: Image, depth: Image, info: CameraInfo) -> None:
        camera = Camera(info.width, info.height, info.k[0], info.k[4], info.k[2], info.k[5])
        stamp = color.header.stamp.sec + 1e-9 * color.header.stamp.nanosec
        try:
            result = self.mapper.add(rgb(color), meters(depth), camera=camera, timestamp=stamp)
        except FrameError as error:
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


def rgb(image: Image) -> np.ndarray:
    """Convert an image message to an RGB image (H, W, 3), uint8."""
    pixels = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)[:, : 3 * image.width]
    pixels = pixels.reshape(image.height, image.width, 3)
    return pixels[..., ::-1] if image.encoding == "bgr8" else pixels


def meters(image: Image) -> np.ndarray:
    """Convert an image message to depth (H, W), float32, m; 0 = no reading."""
    kind, unit = (np.float32, 1.0) if image.encoding == "32FC1" else (np.uint16, 0.001)
    values = np.frombuffer(bytes(image.data), kind).reshape(image.height, -1)[:, : image.width] * np.float32(unit)
    return np.nan_to_num(values, nan=0.0, posinf=0.0).astype(np.float32)


def main() -> None:
    """Run the node."""
    rclpy.init()
    rclpy.spin(InstanceMapNode("fuser.voxel_size=0.02"))


if __name__ == "__main__":
    main()
