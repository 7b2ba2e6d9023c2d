"""Results as files: ``results/*.json`` hold a row a run; the documents' tables are made from them."""
