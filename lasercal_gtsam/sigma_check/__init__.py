"""Whether the sigmas of a calibration hold: its own geometry, new noise, solved again and again.

`study.check_sigma` runs the trials, `redraw` makes their spots, `judge` says what they mean;
`result` holds what comes out.
"""
