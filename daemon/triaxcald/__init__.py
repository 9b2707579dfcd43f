"""The daemon: recording, station, provisioning, audit, command line. Knows the
metrology and the drivers."""
