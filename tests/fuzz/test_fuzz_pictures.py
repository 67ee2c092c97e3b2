"""Pictures of every kind: taken as the camera saved them, or refused in one clear line."""

from __future__ import annotations

from pathlib import Path
from random import Random

import cv2
import numpy as np
import pytest
from fuzz_oracle import run
from fuzz_pictures import HEIGHT, ODD, WIDTH, cmyk_jpeg, encoded, lie, png, spoilt, spot, tiff

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.decoders import decoder_complaints, is_damage
from lasercal_gtsam.io.picture_header import read_picture_header
from lasercal_gtsam.io.pictures import read_picture

COLOUR = spot(3)
GRAY = cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY)
DEEP = COLOUR.astype(np.uint16) * 200
ALPHA = cv2.cvtColor(COLOUR, cv2.COLOR_BGR2BGRA)
FILES = {
    "png": (encoded(".png", COLOUR), COLOUR),
    "png gray": (encoded(".png", GRAY), GRAY),
    "png 16 bit": (encoded(".png", DEEP), DEEP),
    "png with alpha": (encoded(".png", ALPHA), ALPHA),
    "bmp": (encoded(".bmp", COLOUR), COLOUR),
    "bmp gray": (encoded(".bmp", GRAY), GRAY),
    "tiff": (encoded(".tif", COLOUR), COLOUR),
    "tiff deflate": (encoded(".tif", COLOUR, cv2.IMWRITE_TIFF_COMPRESSION, 8), COLOUR),
    "tiff 16 bit": (encoded(".tif", DEEP), DEEP),
    "tiff big endian": (tiff(GRAY, 1, big=True), GRAY),
    "pgm": (encoded(".pgm", GRAY), GRAY),
    "pgm in text": (encoded(".pgm", GRAY, cv2.IMWRITE_PXM_BINARY, 0), GRAY),
    "ppm": (encoded(".ppm", COLOUR), COLOUR),
    "jpeg": (encoded(".jpg", COLOUR), None),
    "jpeg progressive": (encoded(".jpg", COLOUR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), None),
}


def read(folder: Path, content: bytes, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    path = folder / "picture"
    path.write_bytes(content)
    return read_picture(path, size, "id 7")


@pytest.mark.parametrize("kind", FILES)
def test_pixels_come_as_they_were_saved(tmp_path: Path, kind: str) -> None:
    content, pixels = FILES[kind]
    header = read_picture_header(content)
    assert header is not None and (header.width, header.height) == (WIDTH, HEIGHT)
    found = read(tmp_path, content)
    if pixels is not None:
        assert found.dtype == pixels.dtype
        np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize("kind", FILES)
def test_a_truncated_picture_is_refused(tmp_path: Path, kind: str) -> None:
    """Wherever it ends; a decoder would fill the rest with gray."""
    content, _ = FILES[kind]
    whole = read(tmp_path, content)
    for end in range(0, len(content) - 1, max(1, len(content) // 40)):
        try:
            part = read(tmp_path, content[:end])
        except DataError as error:
            assert "id 7: " in str(error) and "\n" not in str(error)
        else:  # only what does not belong to the pixels is missing
            np.testing.assert_array_equal(part, whole)


def test_a_flipped_bit_in_a_png_is_noticed(tmp_path: Path, capfd) -> None:
    content = encoded(".png", COLOUR)
    rng = Random(1)
    for _ in range(100):
        data = bytearray(content)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        with pytest.raises(DataError):
            read(tmp_path, bytes(data))
    assert capfd.readouterr().err == ""


def test_a_jpeg_with_wrong_codes_is_refused(tmp_path: Path, capfd) -> None:
    """The decoder says so on stderr only, and gives a picture all the same."""
    content = bytearray(encoded(".jpg", COLOUR))
    at = content.index(b"\xff\xda") + 14
    content[at : at + 40] = bytes(40)
    assert cv2.imdecode(np.frombuffer(bytes(content), np.uint8), cv2.IMREAD_UNCHANGED) is not None
    assert "Corrupt JPEG data" in capfd.readouterr().err
    with pytest.raises(DataError, match=r"the file is damaged: Corrupt JPEG data"):
        read(tmp_path, bytes(content))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("complaint", "damage"),
    [
        ("Corrupt JPEG data: premature end of data segment", True),
        ("Corrupt JPEG data: bad Huffman code", True),
        ("Corrupt JPEG data: 3 extraneous bytes before marker 0xd9", False),  # padding
        ("Corrupt JPEG data: 481 extraneous bytes before marker 0xd9", True),
        ("Premature end of JPEG file", True),
        ("libpng error: IDAT: CRC error", True),
        ("libpng warning: iCCP: known incorrect sRGB profile", False),
    ],
)
def test_which_complaints_mean_damage(complaint: str, damage: bool) -> None:
    assert is_damage(complaint) is damage


def test_what_others_write_meanwhile_is_passed_on(capfd) -> None:
    import os

    with decoder_complaints() as complaints:
        os.write(2, b"a line of another thread\nlibpng warning: x\n")
    assert complaints == ["libpng warning: x"]
    assert capfd.readouterr().err == "a line of another thread\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (png(1 << 30, 1 << 30, 8, 0, b"\0"), "is 1073741824 x 1073741824 pixels, but its camera"),
        (png(40_000, 40_000, 8, 2, b"\0" * 1000), "is 40000 x 40000 pixels, but its camera has 64"),
        (lie(encoded(".jpg", COLOUR), 65500, 65500), "is 65500 x 65500 pixels"),
        (lie(encoded(".bmp", COLOUR), 1 << 30, 1 << 30), "is 1073741824 x 1073741824 pixels"),
        (lie(encoded(".ppm", COLOUR), 1 << 31, 9), "is 2147483648 x 9 pixels"),
        (tiff(GRAY, 1, t256=1 << 30, t257=1 << 30), "is 1073741824 x 1073741824 pixels"),
        (encoded(".png", GRAY[:1, :1]), "is 1 x 1 pixels, but its camera has 64 x 48"),
        (tiff(np.full((HEIGHT, WIDTH, 4), 50, np.uint8), 5, t332=1), "CMYK"),
        (cmyk_jpeg(), "CMYK"),
        (b"", "the file is empty"),
        (b"GIF89a" + bytes(20), "expected PNG, TIFF, BMP, PGM, PPM or JPEG"),
        (tiff(GRAY, 1, t273=0xFFFFFFF0), "damaged"),
    ],
)  # fmt: skip
def test_bombs_lies_and_printers(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(DataError) as caught:
        read(tmp_path, content)
    assert words in str(caught.value)


def test_more_pixels_than_any_sensor_has(tmp_path: Path) -> None:
    """Refused before memory is taken for them, also where the capture declares them."""
    with pytest.raises(DataError, match=r"of 40000 x 40000 pixels, more than 160 million"):
        read(tmp_path, png(40_000, 40_000, 8, 2, b"\0" * 1000), (40_000, 40_000))


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "capture.yaml").write_text(
        f"lasercal: 1\ncamera: {{width: {WIDTH}, height: {HEIGHT}}}\nposes: {{file: poses.csv, "
        'transform: T_base_hand, length: mm, rotation: kuka}\nimages: {on: "{id}.png"}\n'
    )
    (folder / "poses.csv").write_text("id,plane,x,y,z,a,b,c\np,1,500,0,300,0,0,180\n")
    return folder


@pytest.mark.parametrize("number", range(len(ODD)))
def test_no_odd_picture_ends_the_detector(capture: Path, number: int) -> None:
    (capture / "p.png").write_bytes(ODD[number]())
    outcome = run(["detect", str(capture), "--force"])
    assert outcome.faults == [] and outcome.status in (0, 1), outcome


def test_no_spoilt_picture_ends_the_detector(capture: Path) -> None:
    rng = Random(5)
    for _ in range(60):
        (capture / "p.png").write_bytes(spoilt(rng))
        outcome = run(["detect", str(capture), "--force"])
        assert outcome.faults == [] and outcome.status in (0, 1), outcome


@pytest.mark.parametrize(("value", "dtype"), [(0, np.uint8), (255, np.uint8), (65535, np.uint16)])
def test_black_and_white_hold_no_spot(capture: Path, value: int, dtype: type) -> None:
    (capture / "p.png").write_bytes(encoded(".png", np.full((HEIGHT, WIDTH), value, dtype)))
    outcome = run(["detect", str(capture), "--force", "--json"])
    assert (outcome.status, outcome.faults) == (0, [])
    assert '"verdict": "none"' in outcome.out or '"none"' in outcome.out
