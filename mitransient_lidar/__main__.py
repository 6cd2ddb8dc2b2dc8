"""Run the command line with ``python -m mitransient_lidar``."""

from mitransient_lidar.cli.app import main

if __name__ == "__main__":
    main()
