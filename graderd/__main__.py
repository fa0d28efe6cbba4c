"""``python -m graderd``: the same as the ``graderd`` command."""

from graderd.cli import main

if __name__ == "__main__":
    main()
