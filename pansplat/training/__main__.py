"""`python -m pansplat.training`, as torchrun starts it."""

from pansplat.training import main

if __name__ == "__main__":
    main()
