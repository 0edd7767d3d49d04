import cv2
import numpy as np
import pytest
import torch
from disk import full_disk

from oasis_warp.core.errors import InputError
from oasis_warp.data import pictures
from oasis_warp.data.pictures import to_uint8, write_picture, write_video


def moving_disc(n_frames=8, height=64, width=96):
    for i in range(n_frames):
        frame = np.full((height, width, 3), 240, np.uint8)
        cv2.circle(frame, (10 + 8 * i, 30), 9, (200, 90, 40), -1)
        yield torch.from_numpy(frame)


def read_back(path):
    capture, frames = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), []
    rate = capture.get(cv2.CAP_PROP_FPS)
    while (frame := capture.read())[0]:
        frames.append(cv2.cvtColor(frame[1], cv2.COLOR_BGR2RGB))
    return frames, rate


def rms(a, b):
    return np.mean((a.astype(float) - np.asarray(b, float)) ** 2) ** 0.5


@pytest.fixture(params=["ffmpeg", "opencv"], autouse=True)
def encoder(request, monkeypatch):
    """That of MP4s: with and without an ffmpeg that writes H.264."""
    if request.param == "opencv":
        monkeypatch.setattr(pictures, "h264_encoder", lambda: None)
    return "vp09" if request.param == "opencv" or pictures.h264_encoder() is None else "avc1"


@pytest.mark.parametrize(("suffix", "rate"), [(".mp4", 24), (".gif", 25)])
def test_every_frame_comes_back_in_its_colours(tmp_path, suffix, rate):
    path = tmp_path / f"video{suffix}"
    assert write_video(path, moving_disc(), 24.0) == 8
    frames, got_rate = read_back(path)
    assert got_rate == rate
    assert len(frames) == 8
    assert all(rms(frame, original) < 8 for frame, original in zip(frames, moving_disc(), strict=True))
    assert list(tmp_path.iterdir()) == [path]


def test_an_mp4_is_of_a_kind_that_browsers_play(tmp_path, encoder):
    write_video(tmp_path / "video.mp4", moving_disc(), 24.0)
    data = (tmp_path / "video.mp4").read_bytes()
    assert data[4:8] == b"ftyp"
    assert encoder.encode() in data


def test_the_same_frames_give_the_same_bytes(tmp_path):
    for name in ("a.mp4", "b.mp4"):
        write_video(tmp_path / name, moving_disc(), 24.0)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def in_colour_and_alpha():
    for k, frame in enumerate(moving_disc(3)):
        yield torch.cat([frame, torch.full_like(frame[..., :1], 80 * k)], 2)


def test_a_webp_and_pictures_keep_their_transparency(tmp_path):
    expected = list(in_colour_and_alpha())
    assert write_video(tmp_path / "video.webp", in_colour_and_alpha(), 20.0, loops=3) == 3
    found, animation = cv2.imreadanimation(str(tmp_path / "video.webp"))
    assert found
    assert (len(animation.frames), list(animation.durations), animation.loop_count) == (3, [50] * 3, 3)
    for frame, original in zip(animation.frames, expected, strict=True):
        assert np.abs(frame[..., 3].astype(int) - original[..., 3].numpy()).max() <= 2
    assert write_video(tmp_path / "video", in_colour_and_alpha(), 20.0) == 3
    files = sorted((tmp_path / "video").iterdir())
    assert [file.name for file in files] == ["0001.png", "0002.png", "0003.png"]
    for file, original in zip(files, expected, strict=True):
        back = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
        assert np.array_equal(back[..., [2, 1, 0, 3]], original)
    for suffix in (".mp4", ".gif"):
        with pytest.raises(InputError, match="has no transparency; write .webp"):
            write_video(tmp_path / f"video{suffix}", in_colour_and_alpha(), 20.0)


def test_a_gif_is_shown_as_often_as_was_asked_for(tmp_path):
    write_video(tmp_path / "video.gif", moving_disc(), 24.0, loops=2)
    repeats = b"\x01\x00"  # after the first time
    assert b"NETSCAPE2.0\x03\x01" + repeats + b"\x00" in (tmp_path / "video.gif").read_bytes()


def test_a_gif_loops_for_ever(tmp_path):
    write_video(tmp_path / "video.gif", moving_disc(), 24.0)
    assert b"NETSCAPE2.0\x03\x01\x00\x00\x00" in (tmp_path / "video.gif").read_bytes()


def test_odd_sizes_are_padded_to_even_ones(tmp_path):
    write_video(tmp_path / "video.mp4", moving_disc(3, 63, 95), 24.0)
    frames, _ = read_back(tmp_path / "video.mp4")
    assert frames[0].shape == (64, 96, 3)
    assert rms(frames[0][:63, :95], next(moving_disc(1, 63, 95))) < 8


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, suffix):
    noise = np.random.default_rng(1).integers(0, 255, (6, 96, 96, 3), np.uint8)
    with full_disk(5_000), pytest.raises(InputError, match="free some"):
        write_video(tmp_path / f"video{suffix}", map(torch.from_numpy, noise), 24.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_an_interrupted_video_leaves_nothing(tmp_path, suffix):
    def interrupted():
        yield from moving_disc(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / f"video{suffix}", interrupted(), 24.0)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_a_video_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"ends in \.mp4 or \.gif or \.webp"):
        write_video(tmp_path / "video.avi", moving_disc(), 24.0)
    for suffix in (".mp4", ".gif"):
        with pytest.raises(ValueError, match="frames: expected at least one"):
            write_video(tmp_path / f"video{suffix}", [], 24.0)
    assert list(tmp_path.iterdir()) == []


def pixels(channels):
    generator = torch.Generator().manual_seed(2)
    return torch.randint(0, 256, (20, 30, channels), generator=generator, dtype=torch.uint8)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("suffix", [".png", ".webp", ".PNG"])
def test_pixels_come_back_exactly(tmp_path, suffix, channels):
    image = pixels(channels)
    image[..., 3:].clamp_(1)  # WebP drops the colour of what cannot be seen
    write_picture(tmp_path / f"a{suffix}", image)
    back = cv2.imread(str(tmp_path / f"a{suffix}"), cv2.IMREAD_UNCHANGED)
    assert torch.equal(torch.from_numpy(back)[..., [2, 1, 0, 3][:channels]], image)


def test_colours_are_rounded_and_clipped():
    image = torch.tensor([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 1.0, 7.0]).reshape(1, 2, 3)
    assert to_uint8(image).flatten().tolist() == [0, 0, 0, 1, 255, 255]


def test_what_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"ends in \.png or \.webp or \.jpg"):
        write_picture(tmp_path / "a.exr", pixels(3))
    with pytest.raises(InputError, match="JPEG has no transparency"):
        write_picture(tmp_path / "a.jpg", pixels(4))
    assert list(tmp_path.iterdir()) == []
