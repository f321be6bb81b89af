"""Noise models of depth sensors.

A model returns the standard deviation sigma, m, of a depth reading z, m, on a surface at the angle theta, rad, to the
image plane:

    sigma(z, theta) = max(FLOOR, least + growth (z - near)^2)
                      + (slant / sqrt(z) + far_slant z^1.5) theta^2 / (pi / 2 - theta)^2

| kind | sigma(z, 0) | source |
| --- | --- | --- |
| EXACT | FLOOR | rendered depth, limited by the step of stored depth |
| KINECT_V1 | 1.2 mm + 1.9 mm (z - 0.4)^2 | Nguyen et al. 2012 |
| REALSENSE_D435 | 3.8 mm z^2 | Grunnet-Jepsen et al.: z^2 subpixel / (f baseline) |
| TIME_OF_FLIGHT | 1.5 mm - 0.5 mm z + 0.3 mm z^2 | Fankhauser et al. 2015 |
| PHONE_LIDAR | 10 mm | Luetzenburg et al. 2021, Teo and Yang 2023 |

- Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 3DIMPVT 2012.
- Grunnet-Jepsen, Sweetser and Woodfill, "Tuning depth cameras for best performance", Intel. Baseline 50 mm, 848 px over
  90 degrees (f = 424 px), subpixel 0.08 px, the value of the document's examples.
- Fankhauser et al., "Kinect v2 for Mobile Robot Navigation: Evaluation and Modeling", ICAR 2015. Indoors.
- Luetzenburg, Kroon and Bjork, "Evaluation of the Apple iPhone 12 Pro LiDAR for an Application in Geosciences",
  Scientific Reports 11, 2021: 1 cm for objects of at least 10 cm. Teo and Yang, "Evaluating the accuracy and quality of
  an iPad Pro's built-in lidar for 3D indoor mapping", Developments in the Built Environment 14, 2023: 1 cm in motion.
  Both are errors of scanned surfaces. No published dependence on depth is available.
"""

from __future__ import annotations

import math
import re
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FLOOR = 0.001  # m, the usual step of stored depth; no reading is more accurate


class DepthNoise(NamedTuple):
    """Coefficients of a noise model.

    They are numbers in a flat tuple, because kernels require this type.
    """

    least: float  # m, standard deviation at `near`
    near: float  # m, depth of the smallest standard deviation
    growth: float  # 1 / m, quadratic growth with depth
    slant: float = 0.0  # m^1.5, growth on slanted surfaces
    far_slant: float = 0.0  # m^-0.5, growth on slanted surfaces at larger depths
    full_weight_depth: float = 0.0  # m, depth up to which noise is nearly constant; 0 = noise grows with depth squared


class SensorKind(Enum):
    """Kind of a depth sensor, with its noise model as value."""

    EXACT = DepthNoise(0.0, 0.0, 0.0, full_weight_depth=math.inf)
    KINECT_V1 = DepthNoise(0.0012, 0.4, 0.0019, slant=0.0001)
    REALSENSE_D435 = DepthNoise(0.0, 0.0, 0.08 / (424 * 0.05))
    # the vertex of the published parabola; (2.2 m / z)^2 approximates sigma(1.5 m) / sigma(z) up to 5 m
    TIME_OF_FLIGHT = DepthNoise(0.0015 - 0.0005**2 / (4 * 0.0003), 0.0005 / (2 * 0.0003), 0.0003, 0.0, 0.0001, 2.2)
    PHONE_LIDAR = DepthNoise(0.01, 0.0, 0.0, full_weight_depth=math.inf)

    @property
    def noise(self) -> DepthNoise:
        """The noise model of the sensor."""
        return self.value

    def sigma(self, z: float | NDArray[np.float32]) -> NDArray[np.floating]:
        """Return the standard deviation, m, of readings at depth `z`, m, on surfaces that face the camera."""
        least, near, growth = self.noise[:3]
        return np.maximum(FLOOR, least + growth * (z - near) ** 2)

    def __str__(self) -> str:
        """Return the name and the standard deviations at depths of 1 m and 3 m."""
        near, far = (f"{1000 * self.sigma(z):.1f} mm at {z} m" for z in (1, 3))
        return f"{self.name}, standard deviation of depth {near}, {far}"


class SensorChoice(Enum):
    """Values of `dataset.sensor`."""

    AUTO = "from the recording or the device"
    EXACT = "rendered depth"
    KINECT_V1 = "structured light: Kinect v1, Xtion, Astra"
    REALSENSE_D435 = "active stereo: RealSense D400, Gemini"
    TIME_OF_FLIGHT = "time of flight: Kinect v2, Azure Kinect, Femto"
    PHONE_LIDAR = "LiDAR of an iPhone or iPad"

    def kind(self, stored: SensorKind) -> SensorKind:
        """Return the selected kind of sensor, or `stored` for AUTO."""
        return stored if self is SensorChoice.AUTO else SensorKind[self.name]


_DEVICES = {  # patterns for names of devices, ROS topics and drivers; the first matching pattern is used
    SensorKind.TIME_OF_FLIGHT: r"femto|azure|k4a|kinect[ _]?v?2|l515|depth_to_rgb",
    SensorKind.KINECT_V1: r"astra|xtion|primesense|openni|sr30[05]",
    SensorKind.REALSENSE_D435: r"realsense|\bd4[0-9]{2}|gemini|aligned_depth_to_color|^/device_0/",
}


def kind_of_device(name: str) -> SensorKind | None:
    """Return the kind of the depth sensor for a device name or ROS topic, or None if unknown."""
    return next((kind for kind, words in _DEVICES.items() if re.search(words, name, re.IGNORECASE)), None)
