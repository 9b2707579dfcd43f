"""Hardware: profiles, drivers and decoders. Knows no metrology and no daemon."""
