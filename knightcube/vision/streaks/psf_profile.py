"""Profile of the point spread function (PSF), learned from the streaks of one frame.

The image of a star in a defocused camera is a disc, or a ring if the telescope has a central obstruction.
The streaks of such a frame have flat or double profiles, so that a fit with a Gaussian PSF is uncertain or
fails. The profile is therefore fitted as a sum of Gaussians (`PsfProfile`). The shares of the Gaussians are
the linear least-squares solution on the pixels of all fitted streaks, and the motion and the stars are fitted
again with each new profile.

The profile is the same in all directions. A vibration, in contrast, widens the streaks across their paths but
not at their ends. The residuals at the streak ends therefore show whether the profile is that of the PSF, and
limit the uncertainty of the rate (`uncertainty`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.vision.streaks.fit_windows import FitWindows
from knightcube.vision.streaks.geometry import GAUSSIAN, PsfProfile, StreakScene
from knightcube.vision.streaks.joint_fit import ROUGH, FitProblem, StreakFit, WorkBudget, iterate
from knightcube.vision.streaks.scene_images import gaussian_lights

# Standard deviations of the Gaussians of a profile, as fractions of the width of the scene.
_WIDTHS = (0.5, 0.7, 1.0, 1.3)
_FIRST = PsfProfile(_WIDTHS, (0.0, 0.0, 1.0, 0.0))
# Minimum ratio of fitted to configured width for which a profile is learned.
_LEAST_WIDER = 1.05
# Number of fits of the profile, each followed by a fit of the motion.
_ROUNDS = 3
# Number of solutions for the shares; the pixel noise is computed from the shares before each solution.
_SOLUTIONS = 3
# Residual (standard deviations) above which a pixel contains flux of a star that is not in the scene.
_FOREIGN_SIGMAS = 5.0
# Addition to this limit, as a fraction of the pixel's largest modelled counts for any single Gaussian.
_FOREIGN_SHARE = 0.5
# Model error of a pixel, as a fraction of its counts, which limits the weight of bright stars.
_MODEL_ERROR = 0.02
# Smallest and largest accepted ratio of the flux with the new profile to the flux with the previous profile.
_LIKELY_FLUX = (0.3, 3.0)
# Distance (px) below which two streaks may be the two lines of one double streak.
_DOUBLE = 8.0


def fit_profile(camera: FitProblem, fit: StreakFit) -> StreakFit | None:
    """Return a fit of the motion and the stars of `fit` with a PSF profile learned from their pixels.

    The work of this fit is not added to that of the `camera`, because few frames need it. Returns None if the
    PSF is not wider than configured (the camera is in focus), if the pixels do not determine the profile, or
    if the fit does not succeed.
    """
    if fit.scene.sigma < _LEAST_WIDER * camera.settings.psf_sigma:
        return None
    camera, scene = replace(camera, work=WorkBudget()), _without_doubles(fit.scene)
    if scene.profile == GAUSSIAN:
        scene = replace(scene, profile=_FIRST)
    windows = camera.windows(scene)
    for _ in range(_ROUNDS):
        shares = _shares(camera, scene, windows)
        if shares is None:
            return None
        flux = float(shares.sum())
        profile = PsfProfile(_WIDTHS, tuple((shares / flux).tolist()))
        scene = replace(scene, profile=profile, light=scene.light * flux)
        again = iterate(camera, scene, fit.free, ROUGH, windows)
        if again is None:
            return None
        fit, scene, windows = again, again.scene, camera.windows(again.scene)
    return replace(fit, windows=windows)


def _without_doubles(scene: StreakScene) -> StreakScene:
    """Return the scene without the fainter of each two streaks that may be the two lines of one streak."""
    near = np.linalg.norm(scene.stars[:, None] - scene.stars, axis=2) < _DOUBLE
    return scene.select(~(near & (scene.light > scene.light[:, None])).any(axis=1))


def _shares(camera: FitProblem, scene: StreakScene, windows: FitWindows) -> FloatArray | None:
    """Return the shares (k,) of the k Gaussians that fit the pixels of all stars best.

    The sum of the shares is the ratio of the stars' new flux to their flux in `scene`. Returns None if the
    pixels do not determine the shares, or if this ratio is implausible.
    """
    lights = gaussian_lights(camera.pinhole, camera.shutter, scene, windows)
    frame, pixels, brightest = camera.frame, windows.pixels, lights.max(axis=0)
    shares, usable = np.array(scene.profile.shares), ~frame.bad[pixels]
    for _ in range(_SOLUTIONS):
        model = shares @ lights
        variance = frame.floor[pixels] + np.maximum(model, 0.0) / frame.gain
        residual = np.abs(frame.signal[pixels] - model)
        own = residual < _FOREIGN_SIGMAS * np.sqrt(variance) + _FOREIGN_SHARE * brightest
        weighted = lights * ((usable & own) / (variance + np.square(_MODEL_ERROR * model)))
        try:
            shares = np.linalg.solve(weighted @ lights.T, weighted @ frame.signal[pixels])
        except np.linalg.LinAlgError:
            return None
    return shares if _LIKELY_FLUX[0] < shares.sum() < _LIKELY_FLUX[1] else None
