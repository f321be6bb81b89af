"""InstanceMap builds object-level 3D maps from RGB-D video.

In docstrings, *the paper* is "Incremental Instance-Oriented 3D Semantic Mapping via RGB-D Cameras for Unknown Indoor
Scene" (Discrete Dynamics in Nature and Society, 2020, article 2528954). Numbers in brackets are equation numbers in
docs/method.md, because the formulas of the paper are not available.
"""

__version__ = "0.1.0"
