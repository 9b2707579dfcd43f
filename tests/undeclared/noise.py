"""Noise whose effect on a pose's mean is known exactly: white, first-order, both, and the tones of a machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

KINDS = ("white", "first_order", "mixed")


@dataclass(frozen=True)
class Noise:
    """By axis (3,): rms of the white part and of the first-order part, in g; the latter's memory in samples."""

    white_g: np.ndarray
    first_order_g: np.ndarray
    memory: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, kind: str, rate_hz: float) -> Noise:
        if kind not in KINDS:
            raise ValueError(f"noise {kind!r}: expected one of {', '.join(KINDS)}")
        size = 10 ** rng.uniform(-4.0, -2.7) * rng.uniform(0.5, 1.5, 3)
        memory = rate_hz * 10 ** rng.uniform(np.log10(0.05), np.log10(0.5))
        share = {"white": 0.0, "first_order": 1.0, "mixed": rng.uniform(0.2, 0.8)}[kind]
        return cls(size * np.sqrt(1 - share), size * np.sqrt(share), memory)

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,3) in g; stationary from the first sample."""
        fall = np.exp(-1 / self.memory)
        white = rng.standard_normal((n, 3)) * self.white_g
        driven = rng.standard_normal((n, 3)) * np.sqrt(1 - fall**2)
        driven[0] /= np.sqrt(1 - fall**2)
        return np.asarray(white + lfilter([1.0], [1.0, -fall], driven, axis=0) * self.first_order_g)

    def variance_of_mean(self, n: int) -> np.ndarray:
        """(3,) of n samples, g²."""
        lag = np.arange(1, n)
        pairs = n + 2 * float(np.sum((n - lag) * np.exp(-lag / self.memory)))
        return np.asarray(self.white_g**2 / n + self.first_order_g**2 * pairs / n**2)


@dataclass(frozen=True)
class Shaking:
    """Tones of a machine that runs in some of k poses: ``frequency`` (f,) in cycles a sample, ``amplitude`` (k,f,3) g,
    ``phase`` (k,f,3).
    """

    frequency: np.ndarray
    amplitude: np.ndarray
    phase: np.ndarray

    @classmethod
    def none(cls, poses: int) -> Shaking:
        return cls(np.zeros(0), np.zeros((poses, 0, 3)), np.zeros((poses, 0, 3)))

    @classmethod
    def drawn(cls, rng: np.random.Generator, poses: int, rate_hz: float) -> Shaking:
        tones = int(rng.integers(1, 3))
        frequency = rng.uniform(12.0, min(60.0, 0.45 * rate_hz), tones) / rate_hz
        on = rng.random(poses) < rng.uniform(0.3, 0.7)
        loud = 10 ** rng.uniform(-2.5, -1.8)
        by_axis = rng.uniform(0.2, 1.0, 3)
        by_pose = on * rng.uniform(0.5, 1.5, poses)
        amplitude = loud * by_pose[:, None, None] * np.ones((1, tones, 1)) * by_axis
        return cls(frequency, amplitude, rng.uniform(0, 2 * np.pi, amplitude.shape))

    @property
    def variance(self) -> np.ndarray:
        """(k,3) g² of the samples of each pose."""
        return np.asarray(np.sum(self.amplitude**2, axis=1) / 2)

    def at(self, pose: np.ndarray) -> np.ndarray:
        """(n,3) for samples that belong to poses (n,)."""
        turns = 2 * np.pi * np.arange(len(pose))[:, None] * self.frequency
        out = np.zeros((len(pose), 3))
        for f in range(len(self.frequency)):
            out += self.amplitude[pose, f] * np.sin(turns[:, f, None] + self.phase[pose, f])
        return out

    def variance_of_mean(self, pose: int, n: int) -> np.ndarray:
        """(3,) g², over the phases, which nobody knows."""
        if not len(self.frequency):
            return np.zeros(3)
        kernel = np.sin(np.pi * self.frequency * n) / (n * np.sin(np.pi * self.frequency))
        return np.asarray(np.sum(self.amplitude[pose] ** 2 / 2 * kernel[:, None] ** 2, axis=0))
