"""`python -m gnss_sem_map.cli` is the command `gnss-sem-map`."""

from gnss_sem_map.cli import main

main()
