"""Where a unit stood still: windows of the stream, the noise at every scale, the detector, the ends of its spans."""
