"""`python -m hydrotele.cli`."""

from hydrotele.cli.main import main

if __name__ == "__main__":
    main()
