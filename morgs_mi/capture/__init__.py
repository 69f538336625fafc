"""Multi-view video in, cameras in. The only place where axes flip and lenses are undone."""

from morgs_mi.capture.camera import Camera
from morgs_mi.capture.capture import Capture, Frame, PartialFrame, load_capture
from morgs_mi.capture.colmap import ColmapModel, read_colmap, write_colmap
from morgs_mi.capture.lens import Lens, Undistortion, undistortion
from morgs_mi.capture.live import live_frames
from morgs_mi.capture.poses_bounds import read_poses_bounds, write_poses_bounds
from morgs_mi.capture.reading import ReadConfig
from morgs_mi.capture.rig_check import RigCheck, check_rig, find_common, with_points
from morgs_mi.capture.video import FolderReader, VideoReader, open_frames
from morgs_mi.capture.video_writer import write_video

__all__ = [
    "Camera",
    "Capture",
    "ColmapModel",
    "FolderReader",
    "Frame",
    "Lens",
    "PartialFrame",
    "ReadConfig",
    "RigCheck",
    "Undistortion",
    "VideoReader",
    "check_rig",
    "find_common",
    "live_frames",
    "load_capture",
    "open_frames",
    "read_colmap",
    "read_poses_bounds",
    "undistortion",
    "with_points",
    "write_colmap",
    "write_poses_bounds",
    "write_video",
]
