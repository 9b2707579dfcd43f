"""Monte Carlo of every claim about the numbers, with peers beside ours. `make bench` prints the tables."""
