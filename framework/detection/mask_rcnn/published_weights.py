"""Local network files, and published network files that are downloaded once."""

from __future__ import annotations

import hashlib
import http.client
import logging
import os
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import platformdirs
from tqdm import tqdm

from framework.errors import DataError, in_one_line
from framework.files.atomic_write import atomic_write
from framework.files.search_paths import candidates

OFFLINE = "INSTANCEMAP_OFFLINE"
"""Environment variable that disables downloads if set."""

TIMEOUT = 30.0  # maximum time without a response, s
BLOCK = 1 << 20  # bytes per read

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PublishedNetwork:
    """A published network file.

    The file name contains the first digits of the hash.
    """

    url: str
    algorithm: str  # name in hashlib
    digest: str  # hex, complete or only the first digits
    license: str
    megabytes: int = 0  # 0 = unknown before the download

    @property
    def file(self) -> Path:
        """The path of the file in the user's cache."""
        return networks_folder() / self.url.rpartition("/")[2]

    def digest_of(self, path: Path) -> str:
        """Return the hash of a file, with as many digits as published."""
        with path.open("rb") as file:
            return hashlib.file_digest(file, self.algorithm).hexdigest()[: len(self.digest)]


TORCHVISION = "https://download.pytorch.org/models/"
DETECTRON2 = "https://dl.fbaipublicfiles.com/detectron2/COCO-InstanceSegmentation/"
PUBLISHED = {
    "resnet50_fpn_coco": PublishedNetwork(
        f"{TORCHVISION}maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth", "sha256", "bf2d0c1e", "BSD-3-Clause", 178
    ),
    "resnet50_fpn_coco_detectron2": PublishedNetwork(
        f"{DETECTRON2}mask_rcnn_R_50_FPN_3x/137849600/model_final_f10217.pkl", "md5", "f10217", "CC BY-SA 3.0"
    ),
    "resnet101_fpn_coco_detectron2": PublishedNetwork(
        f"{DETECTRON2}mask_rcnn_R_101_FPN_3x/138205316/model_final_a3ec72.pkl", "md5", "a3ec72", "CC BY-SA 3.0"
    ),
}
"""Published networks of torchvision (published COCO mask AP 34.6) and detectron2 (37.2 and 38.6)."""


def networks_folder() -> Path:
    """Return the cache folder of downloaded networks."""
    return platformdirs.user_cache_path("instancemap", appauthor=False) / "networks"


def find_network(weights: Path) -> Path:
    """Return the path of a network file, and download a published file if necessary.

    Args:
        weights: A path, or a name in PUBLISHED. Relative paths are searched in the working directory, then in the
            project folder.

    Raises:
        DataError: The file does not exist, cannot be downloaded, or has a wrong hash.
    """
    if published := PUBLISHED.get(str(weights)):
        if not published.file.exists():
            download(published)
        check(published)
        return published.file
    for candidate in candidates(weights):
        if candidate.is_file():
            return candidate.resolve()
    searched = " or ".join(str(candidate) for candidate in candidates(weights))
    raise DataError(f"{weights}: expected a file or one of {', '.join(PUBLISHED)}, got none at {searched}")


def check(published: PublishedNetwork) -> None:
    """Raise DataError if a downloaded file does not have the published hash."""
    try:
        found = published.digest_of(published.file)
    except OSError as error:
        raise DataError(f"{published.file}: expected a readable file, got an error ({error.strerror})") from error
    if found != published.digest:
        raise DataError(
            f"{published.file}: expected {published.algorithm} {published.digest}, got {found}; delete it to "
            f"download it again from {published.url}"
        )


def download(published: PublishedNetwork) -> None:
    """Download a published file into the cache."""
    by_hand = f"download {published.url} and put it at {published.file}"
    if os.environ.get(OFFLINE):
        raise DataError(f"{published.file}: expected a file while {OFFLINE} disables downloads, got none; {by_hand}")
    path = published.file
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{path.parent}: expected a writable folder, got an error ({error.strerror})") from error
    with atomic_write(path) as temporary:
        with temporary.open("wb") as file:
            file.writelines(_received(published, by_hand))
        found = published.digest_of(temporary)
        if found != published.digest:
            expected = f"{published.algorithm} {published.digest}"
            raise DataError(f"{published.url}: expected {expected}, got {found}; try again, or {by_hand}")


def _received(published: PublishedNetwork, by_hand: str) -> Iterator[bytes]:
    """Yield the blocks of a file that is downloaded, and show the progress."""
    url, name = published.url, published.file.name
    try:
        with (
            urllib.request.urlopen(url, timeout=TIMEOUT) as response,
            tqdm(total=response.length, unit="B", unit_scale=True, desc=name, disable=None) as progress,
        ):
            announced, received = response.length or 0, 0
            size = f"{announced / 1e6:.0f} MB" if announced else "of unknown size"
            log.info("downloading %s, %s, license %s, into %s", url, size, published.license, published.file.parent)
            while block := response.read(BLOCK):
                received += len(block)
                progress.update(len(block))
                yield block
    except (OSError, http.client.HTTPException) as error:
        reason = in_one_line(getattr(error, "reason", None) or error)
        raise DataError(f"{url}: expected a download, got an error ({reason}); {by_hand}") from error
    if received < announced:
        raise DataError(f"{url}: expected {announced} bytes, got {received}; try again, or {by_hand}")
