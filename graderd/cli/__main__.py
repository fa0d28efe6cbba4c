"""``python -m graderd.cli`` is ``graderd``."""

from graderd.cli import main

if __name__ == "__main__":
    main()
