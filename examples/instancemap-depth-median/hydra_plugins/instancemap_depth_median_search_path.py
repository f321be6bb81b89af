"""Puts this package's conf/ on Hydra's search path: its options are there once it is installed.

Hydra finds this file by its place. The folder hydra_plugins has no __init__.py, for others put theirs into it, too.
"""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin


class DepthMedianSearchPath(SearchPathPlugin):
    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        search_path.append(
            provider="instancemap-depth-median",
            path="pkg://instancemap_depth_median.conf",
        )
