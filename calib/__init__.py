"""Calibration of camera rigs.

`calib.boards` calibrates a rig from images of a calibration board; `calib.images` finds mistakes in a rig, refines it,
or makes an uncalibrated one, from ordinary images. `calib.images` may use `calib.boards`, not the reverse.
"""
