"""Tests for chained refiners, as composed by Hydra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from framework.data import Camera, Frame, PointClusters
from framework.errors import ConfigError, DataError
from plugins.refiners.chain import Chain
from plugins.refiners.connected import Connected
from plugins.refiners.gmm_em import GmmEm
from plugins.refiners.kmeans import KMeans
from plugins.refiners.largest_component import LargestComponent
from plugins.refiners.plane_removal import PlaneRemoval
from tests.support import registered


class Halving(LargestComponent):
    """Refiner that keeps every other point. The result depends on the order of the refiners."""

    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        return PointClusters(
            clusters.points_world[::2],
            clusters.pixels[::2],
            clusters.cluster[::2],
            clusters.class_probabilities,
            clusters.scores,
            clusters.classes,
        )


def line() -> tuple[Frame, PointClusters]:
    camera = Camera(8, 8, 8.0, 8.0, 3.5, 3.5)
    frame = Frame(0, 0.0, np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32), camera)
    points = np.arange(24, dtype=np.float32).reshape(8, 3)
    pixels = np.zeros((8, 2), np.int32)
    ones = np.ones((1, 1), np.float32)
    return frame, PointClusters(points, pixels, np.zeros(8, np.int32), ones, ones[0], ("chair",))


def test_chain_links_refine_in_sequence() -> None:
    frame, clusters = line()
    left = Chain({"first": Halving(), "second": Halving()}).refine(clusters, frame)
    assert left.points_world.tolist() == clusters.points_world[::4].tolist()


def test_chain_link_with_pixels_outside_image_raises() -> None:
    class InvalidPixels(LargestComponent):
        def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
            return replace(clusters, pixels=clusters.pixels - 9)

    frame, clusters = line()
    with pytest.raises(
        DataError, match=r"clusters: expected pixels in the image of 8x8 px, got u in \[-9, -9\], v in \[.*, .*\]"
    ):
        Chain({"first": InvalidPixels(), "second": LargestComponent()}).refine(clusters, frame)


@pytest.mark.parametrize(
    ("overrides", "links"),
    [
        (
            ["refiner.links.gmm_em.std_floor=0.02"],
            {"plane_removal": PlaneRemoval, "gmm_em": GmmEm, "connected": Connected},
        ),
        (["refiner.links.gmm_em=null"], {"plane_removal": PlaneRemoval, "connected": Connected}),
        (
            ["refiner@refiner.links.gmm_em=kmeans"],
            {"plane_removal": PlaneRemoval, "gmm_em": KMeans, "connected": Connected},
        ),
        (
            ["+refiner@refiner.links.last=largest_component"],
            {"plane_removal": PlaneRemoval, "gmm_em": GmmEm, "connected": Connected, "last": LargestComponent},
        ),
    ],
)
def test_chain_overrides_set_remove_replace_and_add_links(overrides: list[str], links: dict[str, type]) -> None:
    chain = registered.built("refiner", "chain", *overrides)
    found = {name: type(link) for name, link in chain.links.items()}
    assert found == links
    assert list(found) == list(links), "expected this order of links"
    if "std_floor" in overrides[0]:
        assert chain.links["gmm_em"].std_floor == 0.02


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["refiner.links.gmm_em.std_flor=1"], "Could not override|std_flor"),
        (["refiner.links.gmm_em.std_floor=-1"], r"^refiner\.links\.gmm_em\.std_floor: expected a value in"),
        (
            ["refiner@refiner.links.gmm_em=gmm_frame", "refiner.links.gmm_em.children=3"],
            r"^refiner\.links\.gmm_em\.children: expected .*; set refiner\.links\.gmm_em\.children=8$",
        ),
        (["refiner.links=3"], "expected plugins by name, got 3|Could not|merge"),
    ],
)
def test_chain_error_names_link(overrides: list[str], message: str) -> None:
    with pytest.raises(Exception, match=message):
        registered.built("refiner", "chain", *overrides)


def test_chain_without_links_error_names_identity() -> None:
    with pytest.raises(ConfigError, match="refiner=identity"):
        Chain({})
