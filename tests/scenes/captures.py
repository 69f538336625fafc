"""Small captures in every layout, all with the same three cameras; frame t of camera i is filled
with (i, t, 0).
"""

import json
from dataclasses import replace
from fractions import Fraction

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from morgs_mi.io.video_writer import write_video
from morgs_mi.testing import assert_close
from tests.scenes.cameras import circle, look_at_cameras, shift_principal_point

WIDTH = 62
HEIGHT = 46
COUNT = 4
FPS = 25
DOT = np.array([0.25, 0.2, 0.1])
LENS = (-0.2, 0.05, 0.003, -0.004, 0.01)  # of OpenCV


def make_camera(i, name, shift=0.0):
    """Return the camera at i radians on a circle, with its own focal length and a shifted principal
    point.
    """
    (view,) = look_at_cameras(circle([i]), 60 + i, WIDTH, HEIGHT, [name], up=(0, 0, 1))
    return shift_principal_point(view, shift, -shift)


def rig(names, shift=0.0):
    """Return cameras on a circle with different focal lengths and principal points `shift` px off
    the centre.
    """
    return [make_camera(i, name, shift) for i, name in enumerate(names)]


def frames(i, count=COUNT, width=WIDTH):
    """Return the clip of camera i."""
    return [np.full((HEIGHT, width, 3), (i, t, 0), np.uint8) for t in range(count)]


def write_image(file, i, t):
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), frames(i)[t][..., ::-1])


def videos(path, names, suffix=".mkv"):
    """Write the clips as .mkv, which can still be read after truncation."""
    for i, name in enumerate(names):
        write_video(path / f"{name}{suffix}", frames(i), FPS)


def write_timed_video(
    path,
    images,
    times,
    codec="ffv1",
    layout="rgb24",
    options=None,
    edit=lambda stream: None,
    time_code="",
):
    """Write a video that shows its frames at `times`, in ascending milliseconds from 0.

    Args:
        path: the file.
        images: the frames, uint8 [H, W, 3], or as `layout` has them.
        times: of the frames.
        codec: FFmpeg's name of it; only `ffv1` is lossless.
        layout: FFmpeg's name of the pixels' layout in `images`.
        options: of the encoder.
        edit: changes the stream before it is written.
        time_code: of the first frame.
    """
    with av.open(str(path), "w") as container:
        if time_code:
            container.metadata["timecode"] = time_code
        period = int(np.gcd.reduce(times)) or 40
        stream = container.add_stream(codec, rate=Fraction(1000, period), options=options)
        stream.height, stream.width = images[0].shape[:2]
        stored = {"ffv1": "bgr0" if layout == "rgb24" else layout, "mjpeg": "yuvj420p"}
        stream.pix_fmt = stored.get(codec, "yuv420p")
        stream.codec_context.time_base = Fraction(period, 1000)
        edit(stream)
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, layout)
            frame.pts = time // period
            frame.time_base = Fraction(period, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_poses_bounds(path, cameras):
    """Write cameras with one focal length and a centred principal point as LLFF does."""
    rows = []
    for camera in cameras:
        right, down, forward = camera.rotation
        size = [camera.height, camera.width, camera.K[0, 0]]
        pose = np.stack([down, right, -forward, camera.position, size], axis=1)
        rows.append([*pose.ravel(), 1, 9])
    np.save(path, np.array(rows))


def n3dv(path, names=("cam00", "cam02", "cam11"), clips=videos):
    path.mkdir(parents=True)
    clips(path, names)
    write_poses_bounds(path / "poses_bounds.npy", rig(names))
    return path


def folder_per_camera(path, names, inner=""):
    for i, name in enumerate(names):
        write_video(path / name / inner, frames(i), FPS)


def folder_per_frame(path, names, inner=""):
    for t in range(COUNT):
        for i, name in enumerate(names):
            write_image(path / f"frame{t:06d}" / inner / f"{name}.png", i, t)


def meet_room(path, clips=videos):
    return n3dv(path, ("cam_0", "cam_2", "cam_10"), clips)


def colmap_text(folder, cameras, model, params, shared):
    """Write a model of cameras with the parameters `params`; if `shared`, all have the first."""
    folder.mkdir(parents=True)
    rows = [
        f"{i + 1} {model} {WIDTH} {HEIGHT} {' '.join(map(repr, p))}"
        for i, p in enumerate(params[: 1 if shared else None])
    ]
    (folder / "cameras.txt").write_text("# cameras\n" + "\n".join(rows) + "\n")
    images = []
    for i, camera in enumerate(cameras):
        x, y, z, w = Rotation.from_matrix(camera.viewmat[:3, :3]).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *camera.viewmat[:3, 3]))
        images.append(f"{i + 1} {pose} {1 if shared else i + 1} {camera.name}.png\n\n")
    (folder / "images.txt").write_text("# images\n" + "".join(images))
    (folder / "points3D.txt").write_text("1 0.1 0.2 0.3 255 0 51 0.5\n")


def colmap(path):
    names = ("cam1", "cam2", "cam10")
    cameras = rig(names, shift=3)
    params = [[c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]] for c in cameras]
    colmap_text(path / "sparse/0", cameras, "PINHOLE", np.array(params).tolist(), shared=False)
    videos(path, names)
    return path


def transforms(path, cameras, k1=0.0):
    """Write a `transforms.json` of cameras that are named as their images."""
    entries = []
    for camera in cameras:
        to_world = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        K = camera.K
        focal = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        entries.append({"file_path": camera.name, "transform_matrix": to_world.tolist(), **focal})
    size = {"w": cameras[0].width, "h": cameras[0].height}
    meta = {"camera_model": "OPENCV", **size, "k1": k1, "frames": entries}
    (path / "transforms.json").write_text(json.dumps(meta))


def nerfstudio(path):
    path.mkdir(parents=True)
    names = ("cam1", "cam2", "cam10")
    cameras = [
        replace(camera, name=f"./images/{camera.name}.png") for camera in rig(names, shift=3)
    ]
    transforms(path, cameras, k1=0.01)
    videos(path, names)
    return path


def dynamic3dgs(path):
    ids = (2, 1, 10)
    cameras = rig(tuple(map(str, ids)), shift=3)
    for i, camera in enumerate(cameras):
        for t in range(COUNT):
            write_image(path / "ims" / camera.name / f"{t:06d}.png", i, t)
    # The order of the cameras may change from frame to frame.
    orders = [np.roll(np.arange(3), t).tolist() for t in range(COUNT)]
    meta = {
        "w": WIDTH,
        "h": HEIGHT,
        "k": [[cameras[i].K.tolist() for i in order] for order in orders],
        "w2c": [[cameras[i].viewmat.tolist() for i in order] for order in orders],
        "fn": [[f"{ids[i]}/{t:06d}.png" for i in order] for t, order in enumerate(orders)],
        "cam_id": [[ids[i] for i in order] for order in orders],
    }
    (path / "train_meta.json").write_text(json.dumps(meta))
    np.savez(path / "init_pt_cld.npz", data=[[1, 2, 3, 0.1, 0.2, 0.3, 1]])
    return path


def anipose(path, distortions=(0, 0, 0, 0, 0), clips=videos):
    """Write a calibration of Anipose, beside clips with names that contain the cameras'."""
    path.mkdir(parents=True)
    names = ("camA", "camB", "camC")
    tables = []
    for i, camera in enumerate(rig(names, shift=3)):
        # OpenCV puts pixel centres at integers.
        K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        entries = {
            "name": json.dumps(camera.name),
            "size": [float(WIDTH), float(HEIGHT)],
            "matrix": K.tolist(),
            "distortions": list(map(float, distortions)),
            "rotation": Rotation.from_matrix(camera.viewmat[:3, :3]).as_rotvec().tolist(),
            "translation": camera.viewmat[:3, 3].tolist(),
        }
        tables.append(
            "\n".join([f"[cam_{i}]", *(f"{key} = {value}" for key, value in entries.items())])
        )
    text = "\n\n".join([*tables, "[metadata]\nadjusted = false\nerror = 0.2\n"])
    (path / "calibration.toml").write_text(text)
    clips(path, tuple(f"trial_1-{name}" for name in names))
    return path


QUALISYS = """  <camera active="1" calibrated="true" serial="{serial}"
    model="Miqus Video" viewrotation="0">
    <fov_video left="10" top="20" right="{right}" bottom="{bottom}"/>
    <transform x="{x}" y="{y}" z="{z}" {axes}/>
    <intrinsic focallength="9.27"
      sensorMinU="0.0" sensorMaxU="122879.0" sensorMinV="0.0" sensorMaxV="69631.0"
      focalLengthU="{fu}" focalLengthV="{fv}" centerPointU="{cu}" centerPointV="{cv}" skew="0.0"
      radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="0.0"
      tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/>
  </camera>
"""


def qualisys(path, distortions=(0, 0, 0, 0)):
    """Write a calibration of Qualisys with a marker camera that has no clip, beside clips named
    after the others.
    """
    path.mkdir(parents=True)
    names = ("26580", "28984", "29005", "31111")
    elements = []
    for camera in rig(names, shift=3):
        right, down, forward = camera.viewmat[:3, :3]
        axes = np.stack([right, -down, -forward])
        values = dict(zip("xyz", 1000 * camera.position, strict=True))
        values["axes"] = " ".join(
            f'r{i + 1}{j + 1}="{axes[i, j]}"' for i in range(3) for j in range(3)
        )
        # The image begins at column 10 and row 20 of the sensor.
        (fu, _, cu), (_, fv, cv) = 64 * (camera.K[:2] + np.array([[0, 0, 10], [0, 0, 20]]))
        values |= {
            "fu": fu,
            "fv": fv,
            "cu": cu,
            "cv": cv,
            "right": 9 + WIDTH,
            "bottom": 19 + HEIGHT,
        }
        values |= dict(zip(("k1", "k2", "p1", "p2"), distortions, strict=True))
        elements.append(QUALISYS.format(serial=camera.name, **values))
    text = f"<calibration>\n <cameras>\n{''.join(elements)} </cameras>\n</calibration>\n"
    (path / "rig.qca.txt").write_text(text)
    videos(path, tuple(f"trial_Miqus_{i}_{name}" for i, name in enumerate(names[:3])))
    return path


def easymocap(path, distortions=(0, 0, 0, 0, 0), clips=folder_per_camera, lens_key="dist"):
    """Write a calibration of EasyMocap with a camera that has no clip, beside the clips of the
    others in `images`.
    """
    path.mkdir(parents=True)
    names = ("1", "2", "10", "31")
    intrinsics = cv2.FileStorage(str(path / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    poses = cv2.FileStorage(str(path / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for storage in (intrinsics, poses):
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in names:
            storage.write("", name)
        storage.endWriteStruct()
    for camera in rig(names, shift=3):
        # OpenCV puts pixel centres at integers.
        K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        intrinsics.write(f"K_{camera.name}", K)
        intrinsics.write(f"{lens_key}_{camera.name}", np.array([distortions], np.float64))
        rotation = camera.viewmat[:3, :3]
        poses.write(f"R_{camera.name}", Rotation.from_matrix(rotation).as_rotvec()[:, None])
        poses.write(f"Rot_{camera.name}", rotation)
        poses.write(f"T_{camera.name}", camera.viewmat[:3, 3:])
    intrinsics.release()
    poses.release()
    clips(path / "images", names[:3])
    return path


def dot_clips(path, names, point, lens, deviation=1.5):
    """Write clips of a bright dot at `point`, `deviation` px wide, recorded through OpenCV's lens
    by the rig with principal points off by 3.

    The cameras of the clips are sorted by `names`.
    """
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    for camera, name in zip(rig(names, shift=3), names, strict=True):
        V = np.asarray(camera.viewmat)
        K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        u, v = cv2.projectPoints(point[None], V[:3, :3], V[:3, 3], K, np.array(lens))[0].ravel()
        dot = 255 * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / deviation**2)
        write_video(path / name, [np.repeat(dot[..., None], 3, -1).astype(np.uint8)] * COUNT, FPS)


def shown_dot(image):
    """Return the position [2] of the dot of `dot_clips` in an image, with pixel centres at +0.5."""
    weights = np.where(image[..., 0] > 60, image[..., 0], 0).astype(float)
    y, x = np.indices(weights.shape) + 0.5
    return np.array([(weights * x).sum(), (weights * y).sum()]) / weights.sum()


def assert_dot_is_shown(capture):
    """Assert that the images of `dot_clips` show DOT where the cameras project it."""
    for camera, image in zip(capture.cameras, next(capture.frames()).images, strict=True):
        assert_close(shown_dot(image), camera.project(DOT)[0], atol=0.15)


def assert_is_rig(capture):
    """Assert that a capture has the cameras of the rig with their principal points off by 3, and
    their clips.
    """
    for camera, expected in zip(capture.cameras, rig(capture.names, shift=3), strict=True):
        assert_close(camera.viewmat, expected.viewmat, atol=1e-9)
        assert_close(camera.K, expected.K, atol=1e-6)
    assert [image[20, 30, 0] for image in next(capture.frames()).images] == [0, 1, 2]
