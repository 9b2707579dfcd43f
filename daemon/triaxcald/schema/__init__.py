"""One model for each document of the daemon: it checks what is written, reads
what was written, and yields the JSON Schema and the page of the reference. The
base of the models, and their blocks of figures, are `triaxcal.schema`."""
