from camera_files import jpeg_with

from heatsplat.datamodules.formats.jpeg import segments


def test_segments_come_in_order_up_to_the_scan():
    found = [(marker, payload) for marker, payload in segments(jpeg_with(0xE3, [b"one", b"two"])) if marker == 0xE3]
    assert found == [(0xE3, b"one"), (0xE3, b"two")]


def test_what_is_no_jpeg_or_ends_early_has_no_more():
    assert list(segments(b"")) == [] and list(segments(b"PNG?")) == []
    assert list(segments(b"\xff\xd8\xff\xe1\x00\x01rest")) == []
    assert list(segments(b"\xff\xd8\xff\xe1\x00\x09ab")) == [(0xE1, b"ab")]
