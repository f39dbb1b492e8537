"""Settings of the classical methods."""

from __future__ import annotations

from dataclasses import dataclass, field

from knightcube.vision.startracker.identification.verification import VerificationSettings


@dataclass(frozen=True, slots=True)
class ClassicalSettings:
    """One set for all methods; each uses some of it.

    Attributes:
        brightest: observed stars of which patterns are made.
        tolerance: of an angle, an area or a moment, in its sigmas.
        patterns: triangles or pivots that are looked up in a table at most.
        joins: triangles made of pairs at most, over all scales: each takes half a millisecond, and a list
            without a match takes them all.
        candidates: of all patterns together, that are laid over the field at most: the budget of work.
        screened: observed stars, the brightest, that a candidate is laid over before it is verified.
        verified: candidates of a pattern that the whole field verifies at most.
        scale_step: relative half width of the scales that one look-up covers.
        scales: look-ups at most; a field that would need more is rejected.
        verification: when a candidate is accepted.
    """

    brightest: int = 11
    tolerance: float = 3.0
    patterns: int = 80
    joins: int = 24
    candidates: int = 2500
    screened: int = 14
    verified: int = 4
    scale_step: float = 0.002
    scales: int = 9
    verification: VerificationSettings = field(default_factory=VerificationSettings)


DEFAULT = ClassicalSettings()
