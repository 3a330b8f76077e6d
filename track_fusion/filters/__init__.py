"""Filters, one a file, all behind the interface of base.py: predict and update, state in, state out.

A filter holds parameters alone; its states are values, batched over leading axes:

>>> import numpy as np
>>> from track_fusion.filters.extended import Extended
>>> from track_fusion.models.measurement import RangeBearingSensor
>>> from track_fusion.models.motion import MotionParams, NearlyConstantVelocity
>>> from track_fusion.tracks import planar_layout
>>> layout = planar_layout()
>>> motion, radar = NearlyConstantVelocity(layout, MotionParams()), RangeBearingSensor(layout, 10.0, 0.01)
>>> one = Extended()
>>> state = one.begin(np.tile([1000.0, 500.0, 5.0, 0.0], (300, 1)), 100.0 * np.eye(4)[None])  # 300 Monte Carlo runs
>>> state, learned = one.update(one.predict(state, motion.over(1.0)), np.array([1120.0, 0.46]), radar)
>>> mean, cov = state.moments
>>> mean.shape, cov.shape, learned.log_likelihood.shape
((300, 4), (300, 4, 4), (300,))
"""
