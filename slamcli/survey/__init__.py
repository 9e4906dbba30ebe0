"""Surveys: frames of a camera with six degrees of freedom over a plane, without a calibration.

A drone, an underwater vehicle, a microscope or a phone looks about straight down, from a height and
with a tilt that vary. Frames are described by SIFT points, pairs of frames that may overlap are
found by appearance, each pair is verified by one homography and by its pixels, and a bundle
adjustment over the plane estimates every frame's pose, tilt and height with the lens that all
share. Tilt and height have priors whose sigmas are estimated from the frames themselves (empirical
Bayes), so that a rigid mount stays rigid and a hand-held camera is free.
"""

from slamcli.survey.features import SurveyFeatures, survey_features
from slamcli.survey.survey import Survey, SurveyMap, survey

__all__ = ["Survey", "SurveyFeatures", "SurveyMap", "survey", "survey_features"]
