"""Files over the link: CFDP class 2 (CCSDS 727.0-B-5), both ends, resumed over gaps, kills and restarts."""
