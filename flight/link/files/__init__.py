"""File transfers over the link by CFDP class 2 (CCSDS 727.0-B-5), resumed after link gaps and restarts."""
