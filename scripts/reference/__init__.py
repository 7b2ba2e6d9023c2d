"""The reference implementation of DPPO (irom-princeton/dppo), and the tasks on which it meets ours."""
