"""`python -m verify.preflight`: see `verify.preflight.command`."""

from verify.preflight.command import main

if __name__ == "__main__":
    main()
