"""Rendered frames with their ground truth."""

from morgs_mi.extras.synth.ground_truth import compute_ground_truth

FPS = 30.0


def render_frame(tracer, camera, frame):
    """Return the image and the ground truth of a frame."""
    time = frame / FPS
    tracer.set_time(time)
    surface = tracer.surface_points(camera)
    poses = [tracer.poses(time + step / FPS) for step in (0, -1, 1)]
    return tracer.render(camera, 16, frame), compute_ground_truth(camera, surface, *poses)
