"""``python -m roboxim_bringup`` is the ``roboxim`` command."""

from roboxim_bringup.cli import main

if __name__ == "__main__":
    main()
