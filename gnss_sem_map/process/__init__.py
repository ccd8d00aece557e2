"""Where the work is done: machine, memory, threads, executors (in process, processes, Dask), statistics, progress."""
