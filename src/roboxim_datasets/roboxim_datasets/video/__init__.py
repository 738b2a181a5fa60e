"""Videos of datasets, encoded and decoded by worker processes.

PyAV's wheel bundles FFmpeg with GPL codecs (x264, x265). `roboxim_datasets.video.worker` alone imports it, in a process
of its own that receives raw frames and file names over a pipe. The rest of RoboXim talks to it through
`roboxim_datasets.video.client`.
"""
