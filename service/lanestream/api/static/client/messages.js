// The messages of the service, generated from their JSON Schemas by `make js-types`. Do not edit.
export {};
