"""What exports say about themselves, and what other files say there."""

import pytest

from framework.detection.runtimes.export_metadata import ExportMetadata


def test_an_export_of_ultralytics():
    texts = {"names": "{0: 'person', 1: 'dog'}", "imgsz": "[480, 640]", "author": "Ultralytics", "stride": "32"}
    assert ExportMetadata.parse(texts) == ExportMetadata(("person", "dog"), (480, 640), "Ultralytics")
    assert ExportMetadata.parse({"names": '{"1": "dog", "0": "person"}', "imgsz": "640"}) == ExportMetadata(
        ("person", "dog"), (640, 640)
    )


OTHER = (
    "",
    "person",
    "[",
    "{0: 'a', 2: 'b'}",
    "{'x': 'a'}",
    "['a']",
    "[1, 2, 3]",
    "[0, 0]",
    "[-1, 5]",
    "__import__('os')",
)


@pytest.mark.parametrize("text", OTHER)
def test_other_texts_say_nothing(text):
    assert ExportMetadata.parse({"names": text, "imgsz": text}) == ExportMetadata()
