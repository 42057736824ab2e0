"""`python -m hydrotele` is the command `hydrotele`."""

from hydrotele.cli.start import main

if __name__ == "__main__":
    main()
