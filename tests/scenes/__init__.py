"""Small scenes that several test modules share.

`gaussians` and `cameras` build random and simple scenes; `plugin` puts one into Mitsuba. `ball`, `moving_splats`,
`changing_splats` and `coded_clip` are fixed scenes with their images or streams. `captures`, `textured` and
`recording` are captures.
"""
