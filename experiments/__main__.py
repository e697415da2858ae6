"""`python -m experiments`; processes of an ensemble load this file too, and need none of the commands."""

if __name__ == "__main__":
    from experiments.commands import main

    main()
