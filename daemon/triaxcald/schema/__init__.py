"""One model for each document of the daemon: it checks what is written, reads
what was written, and yields the JSON Schema and the page of the reference."""
