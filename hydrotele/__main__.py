"""Run the command `hydrotele` by `python -m hydrotele`."""

from hydrotele.cli.start import main

if __name__ == "__main__":
    main()
