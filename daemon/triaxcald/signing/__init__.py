"""Signatures of recordings: keys, envelopes, the file of trusted keys, the chain of a
station's recordings, and time stamps. The only room that imports cryptography."""
