"""``python -m roboxim_cli`` is the ``roboxim`` command."""

from roboxim_cli.main import main

if __name__ == "__main__":
    main()
