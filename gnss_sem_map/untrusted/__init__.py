"""Reading what others wrote: sizes are known before anything is allocated, and only our own errors come out."""
