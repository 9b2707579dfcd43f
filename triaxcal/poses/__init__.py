"""Still spans as poses: their means, and the spectrum of the noise that tells how far these may be trusted."""
