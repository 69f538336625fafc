"""Cameras of a training run of 3D Gaussian Splatting."""

import json

import numpy as np

from morgs_mi.playback.default_rig import model_cameras


def test_model_cameras__names_keys_that_it_does_not_understand_once(tmp_path, caplog):
    row = {
        "id": 0,
        "img_name": "a",
        "width": 62,
        "height": 46,
        "position": [0, 0, 0],
        "rotation": np.eye(3).tolist(),
    }
    rows = [row | {"fx": 50, "fy": 50, "k1": 0.1}, row | {"fx": 50, "fy": 50, "cx": 3}]
    (tmp_path / "cameras.json").write_bytes(json.dumps(rows).encode("utf-8-sig"))
    assert len(model_cameras(tmp_path / "a.ply")) == 2
    assert caplog.messages == [f"{tmp_path / 'cameras.json'}: not understood and not used: cx, k1."]
