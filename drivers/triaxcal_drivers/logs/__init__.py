"""Logs of a bus that other programs recorded: BLF, ASC, candump, TRC, MF4,
pcap."""
