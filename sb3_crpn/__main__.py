"""``sb3-crpn``, or ``python -m sb3_crpn``: rl-zoo's scripts with CRPN and ACRPN."""

from sb3_crpn.cli import parse


def main() -> None:
    """Run the script that the command line names; usage messages come without PyTorch."""
    parse()
    from sb3_crpn.zoo import main as run_script

    run_script()


if __name__ == "__main__":
    main()
