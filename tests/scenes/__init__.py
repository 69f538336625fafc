"""Small scenes that several test modules share.

`gaussians`, `extremes` and `cameras` build random and simple scenes; `plugin` puts one into Mitsuba. `ball`,
`moving_splats`, `changing_splats`, `coded_clip` and `short_clip` are fixed scenes with their images or streams.
`captures`, `noise_capture`, `textured` and `recording` are captures.
"""
