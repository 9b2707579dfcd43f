"""``python -m triaxcald.cli``: the command line without its script."""

from triaxcald.cli.main import entry

if __name__ == "__main__":
    entry()
