"""The commands of `rass-mav`: each module here has `register(subparsers)`; see `rass_mav.cli`."""
