"""URLs without their secrets, whatever the login holds and wherever it stands."""

from __future__ import annotations

import pytest

from lanestream_client.redaction import redact_url, redact_urls, with_escaped_login


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("rtsp://camera/1", "rtsp://camera/1"),
        ("rtsp://[fe80::1]:554/1", "rtsp://[fe80::1]:554/1"),
        ("rtsp://u:secret@camera:554/1", "rtsp://camera:554/1"),
        ("rtsp://u:se#cret@camera/1", "rtsp://camera/1"),
        ("rtsp://u:se/cret@camera/1", "rtsp://camera/1"),
        ("rtsp://u:se?cret@camera/1", "rtsp://camera/1"),
        ("rtsp://u:se@cret@camera/1", "rtsp://camera/1"),
        ("rtsp://u:s/e@c?r#et@camera/1", "rtsp://camera/1"),
        ("rtsp://u:12/secret@camera/1", "rtsp://camera/1"),
        ("rtsp://secret@camera/1", "rtsp://camera/1"),
        ("rtsp://u:%73ecret@camera/1", "rtsp://camera/1"),
        ("http://camera/video.cgi?user=u&password=secret", "http://camera/video.cgi..."),
        ("http://camera:80/video.cgi?password=sec@ret&user=u", "http://..."),
        ("http://u:secret@camera/v?password=sec@ret", "http://..."),
        ("rtsp://camera/user=u_password=secret_channel=1.sdp?real_stream", "rtsp://camera/user..."),
        ("rtsp://camera/user=u&password=secret&channel=1", "rtsp://camera/user..."),
        ("http://camera/mjpg?secret", "http://camera/mjpg..."),
        ("http://camera/mjpg#token=secret", "http://camera/mjpg..."),
        ("http://camera/@front", "http://camera/@front"),
        ("u:sec/ret@camera:8000", "camera:8000"),
    ],
)
def test_no_secret_is_shown(url: str, shown: str) -> None:
    assert redact_url(url) == shown
    assert redact_urls(f"can't open '{url}': why") == f"can't open '{shown}': why" if "://" in url else True


@pytest.mark.parametrize(
    ("url", "escaped"),
    [
        ("rtsp://camera:554/1?a=b@c", "rtsp://camera:554/1?a=b@c"),
        ("rtsp://[fe80::1]/1@2", "rtsp://[fe80::1]/1@2"),
        ("rtsp://u:p@camera/1", "rtsp://u:p@camera/1"),
        ("rtsp://u:p%23@camera/1", "rtsp://u:p%23@camera/1"),
        ("rtsp://u:p@1@camera/1", "rtsp://u:p%401@camera/1"),
        ("rtsp://u:p#1/2?3@camera:554/1", "rtsp://u:p%231%2F2%3F3@camera:554/1"),
        ("rtsp://u:#@camera/1", "rtsp://u:%23@camera/1"),
    ],
)
def test_a_login_is_escaped_for_ffmpeg(url: str, escaped: str) -> None:
    assert with_escaped_login(url) == escaped
