"""Small scenes that several test modules share.

| what a test needs | module |
|---|---|
| random or flat clouds of Gaussians; cameras on a plane, an arc or a circle | `gaussians`, `cameras` |
| the extremes of float32, with their tolerances | `extremes` |
| a Mitsuba scene of Gaussians, alone or among surfaces | `plugin`, `surfaces` |
| images of Gaussians that a fit reconstructs | `ball`; `shifted_ball` for the next frame |
| a stream with known motion; with births and deaths; with the range of the codec | `moving_splats`, `changing_splats`, `coded_clip` |
| a stream to damage | `short_clip` |
| a capture in each layout | `captures` |
| a capture for the command line; with matches and true poses | `noise_capture`, `textured` |
| a fit that is killed; clips of moving planes; cameras that record meanwhile | `recording`, `filmed`, `live_clip` |
| clips that are cut, networks, a full disk | `edit_lists`, `tiny_network`, `full_disk` |
"""  # noqa: E501
